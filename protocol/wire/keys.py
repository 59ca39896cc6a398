"""All key expressions, built and parsed only here (docs/protocol.md, "Keys")."""

from protocol.errors import ConfigError
from protocol.site.site_config import NAME

ROOT = "sitegrid"


def check_name(name: str, what: str) -> str:
    """Return a name fit for a key; ConfigError, also for wildcards."""
    if not NAME.fullmatch(name):
        raise ConfigError(what, f"{name!r} is not a name: use lower-case letters, digits, - and _, at most 63")
    return name


def ingest(site: str, machine: str) -> str:
    """Samples of a machine: query with payload, reply is the acknowledgement."""
    return f"{ROOT}/{check_name(site, 'site')}/ingest/{check_name(machine, 'machine')}"


def ingest_all(site: str) -> str:
    """Samples of all machines."""
    return f"{ROOT}/{check_name(site, 'site')}/ingest/*"


def pose(site: str, machine: str) -> str:
    """Live position."""
    return _machine(site, machine, "pose")


def poses_all(site: str) -> str:
    """Live positions of all machines."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/pose"


def health(site: str, machine: str) -> str:
    """Health of an agent."""
    return _machine(site, machine, "health")


def health_all(site: str) -> str:
    """Health of all agents."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/health"


def alive(site: str, machine: str) -> str:
    """Liveliness token of an agent."""
    return _machine(site, machine, "alive")


def alive_all(site: str) -> str:
    """Liveliness tokens of all agents."""
    return f"{ROOT}/{check_name(site, 'site')}/machine/*/alive"


def sensors(site: str, machine: str) -> str:
    """Readings of a simulated machine or remote driver."""
    return _machine(site, machine, "sensors")


def corrections(site: str, base: str) -> str:
    """RTCM3 of a base."""
    return f"{ROOT}/{check_name(site, 'site')}/corrections/{check_name(base, 'base')}"


def corrections_all(site: str) -> str:
    """RTCM3 of all bases."""
    return f"{ROOT}/{check_name(site, 'site')}/corrections/*"


def map_query(site: str, query: str) -> str:
    """A map query: point, region, history, info, ..."""
    return f"{ROOT}/{check_name(site, 'site')}/map/{check_name(query, 'query')}"


def map_queries_all(site: str) -> str:
    """All map queries."""
    return f"{ROOT}/{check_name(site, 'site')}/map/*"


def changed(site: str) -> str:
    """Change events of the map, for subscribers; refused as a query."""
    return map_query(site, "changed")


def admin(site: str, command: str) -> str:
    """A command to the map server: trust."""
    return f"{ROOT}/{check_name(site, 'site')}/admin/{check_name(command, 'command')}"


def admin_all(site: str) -> str:
    """All commands to the map server."""
    return f"{ROOT}/{check_name(site, 'site')}/admin/*"


def writer(site: str) -> str:
    """Query for the writer of a site, answered by map servers."""
    return f"{ROOT}/{check_name(site, 'site')}/writer"


def follower_query(site: str, follower: str, query: str) -> str:
    """A map query to one follower."""
    return f"{_follower(site, follower)}/{check_name(query, 'query')}"


def follower_queries(site: str, follower: str) -> str:
    """All queries to a follower."""
    return f"{_follower(site, follower)}/*"


def follower_queries_all(site: str) -> str:
    """All queries to any follower."""
    return f"{ROOT}/{check_name(site, 'site')}/follower/*/*"


def follower_alive(site: str, follower: str) -> str:
    """Liveliness token of an answering follower."""
    return f"{_follower(site, follower)}/alive"


def followers_alive_all(site: str) -> str:
    """Liveliness tokens of all followers."""
    return f"{ROOT}/{check_name(site, 'site')}/follower/*/alive"


def follower_owner(site: str, follower: str) -> str:
    """Query for the process that holds a follower's name."""
    return _follower(site, follower)


def follower_of(key: str) -> str:
    """A key's follower; ConfigError."""
    parts = key.split("/")
    if len(parts) == 5 and parts[0] == ROOT and parts[2] == "follower":
        return check_name(parts[3], f"key {key}")
    raise ConfigError(f"key {key}", "names no follower")


def machine_of(key: str) -> str:
    """The machine in a key of `ingest/` or `machine/`; ConfigError."""
    parts = key.split("/")
    if len(parts) >= 4 and parts[0] == ROOT and parts[2] in ("ingest", "machine"):
        return check_name(parts[3], f"key {key}")
    raise ConfigError(f"key {key}", "names no machine")


def query_of(key: str) -> str:
    """A key's map query or command."""
    return key.rsplit("/", 1)[-1]


def _machine(site: str, machine: str, leaf: str) -> str:
    return f"{ROOT}/{check_name(site, 'site')}/machine/{check_name(machine, 'machine')}/{leaf}"


def _follower(site: str, follower: str) -> str:
    return f"{ROOT}/{check_name(site, 'site')}/follower/{check_name(follower, 'follower')}"
