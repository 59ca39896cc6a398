"""All key expressions, built and parsed here and nowhere else (docs/protocol.md, "Keys")."""

from protocol.errors import ConfigError
from protocol.site.site_config import NAME

ROOT = "sitegrid"


def check_name(name: str, what: str) -> str:
    """Return the name of a site, machine or station if it may stand in a key; a wildcard never may."""
    if not NAME.fullmatch(name):
        raise ConfigError(what, f"{name!r} is not a name: use lower-case letters, digits, - and _, at most 63")
    return name


def ingest(site: str, machine: str) -> str:
    """Samples of one machine: query with payload, the reply is the acknowledgement."""
    return f"{ROOT}/{check_name(site, 'site')}/ingest/{check_name(machine, 'machine')}"


def ingest_all(site: str) -> str:
    """Samples of all machines of a site, which the map server answers."""
    return f"{ROOT}/{check_name(site, 'site')}/ingest/*"


def pose(site: str, machine: str) -> str:
    """Live position."""
    return _machine(site, machine, "pose")


def poses_all(site: str) -> str:
    """Live positions of every machine."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/pose"


def health(site: str, machine: str) -> str:
    """Health of one agent."""
    return _machine(site, machine, "health")


def health_all(site: str) -> str:
    """Health of every agent."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/health"


def alive(site: str, machine: str) -> str:
    """Liveliness token of one agent."""
    return _machine(site, machine, "alive")


def alive_all(site: str) -> str:
    """Liveliness tokens of every agent."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/alive"


def sensors(site: str, machine: str) -> str:
    """Readings of a simulated machine or a remote driver."""
    return _machine(site, machine, "sensors")


def corrections(site: str, base: str) -> str:
    """RTCM3 of one base, for receivers."""
    return f"{ROOT}/{check_name(site, 'site')}/corrections/{check_name(base, 'base')}"


def corrections_all(site: str) -> str:
    """RTCM3 of every base of a site."""
    return f"{ROOT}/{check_name(site, 'site')}/corrections/*"


def map_query(site: str, query: str) -> str:
    """One of the map's queryables: point, region, history, info, ..."""
    return f"{ROOT}/{check_name(site, 'site')}/map/{check_name(query, 'query')}"


def map_queries_all(site: str) -> str:
    """Every queryable of a site's map."""
    return f"{ROOT}/{check_name(site, 'site')}/map/*"


def changed(site: str) -> str:
    """Events: an area of the map changed. It is for subscribers; as a query it is refused."""
    return map_query(site, "changed")


def admin(site: str, command: str) -> str:
    """One of the commands to the map server: trust."""
    return f"{ROOT}/{check_name(site, 'site')}/admin/{check_name(command, 'command')}"


def admin_all(site: str) -> str:
    """Every command to the map server of a site."""
    return f"{ROOT}/{check_name(site, 'site')}/admin/*"


def writer(site: str) -> str:
    """Who takes the samples of a site: a query that map servers answer, and ask each other."""
    return f"{ROOT}/{check_name(site, 'site')}/writer"


def follower_query(site: str, follower: str, query: str) -> str:
    """A map query to one follower, which nobody else answers."""
    return f"{_follower(site, follower)}/{check_name(query, 'query')}"


def follower_queries(site: str, follower: str) -> str:
    """All that one follower is asked."""
    return f"{_follower(site, follower)}/*"


def follower_queries_all(site: str) -> str:
    """All that any follower is asked."""
    return f"{ROOT}/{check_name(site, 'site')}/follower/*/*"


def follower_alive(site: str, follower: str) -> str:
    """Liveliness token of one follower: it is there while the follower answers."""
    return f"{_follower(site, follower)}/alive"


def followers_alive_all(site: str) -> str:
    """Liveliness tokens of every follower."""
    return f"{ROOT}/{check_name(site, 'site')}/follower/*/alive"


def follower_owner(site: str, follower: str) -> str:
    """Which process has the name of a follower: a query that followers of one name ask each other."""
    return _follower(site, follower)


def follower_of(key: str) -> str:
    """Name of the follower in a key; a ConfigError where there is none."""
    parts = key.split("/")
    if len(parts) == 5 and parts[0] == ROOT and parts[2] == "follower":
        return check_name(parts[3], f"key {key}")
    raise ConfigError(f"key {key}", "names no follower")


def machine_of(key: str) -> str:
    """Name of the machine in a key of `ingest/` or `machine/`; a ConfigError where there is none."""
    parts = key.split("/")
    if len(parts) >= 4 and parts[0] == ROOT and parts[2] in ("ingest", "machine"):
        return check_name(parts[3], f"key {key}")
    raise ConfigError(f"key {key}", "names no machine")


def query_of(key: str) -> str:
    """Name of the map query, or of the command, that a key asks for."""
    return key.rsplit("/", 1)[-1]


def _machine(site: str, machine: str, leaf: str) -> str:
    return f"{ROOT}/{check_name(site, 'site')}/machine/{check_name(machine, 'machine')}/{leaf}"


def _follower(site: str, follower: str) -> str:
    return f"{ROOT}/{check_name(site, 'site')}/follower/{check_name(follower, 'follower')}"
