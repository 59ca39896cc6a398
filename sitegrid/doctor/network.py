"""The network from this host: router, map server, clocks, versions, permission to send samples.

Zenoh denies silently, so a check without an answer says what the silence may mean.
"""

from __future__ import annotations

import math
import secrets
import socket
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from protocol.errors import LinkError, MessageError, Refusal
from protocol.machine.samples import empty
from protocol.queries.answer_codec import decode_info, decode_machines
from protocol.queries.answers import FollowerState, MachineState, MapInfo
from protocol.queries.origin import SHOWN_S
from protocol.site.site_config import SiteConfig
from protocol.version import UNKNOWN
from protocol.wire import keys
from protocol.wire.codec import decode_health, decode_reply, encode_batch
from protocol.wire.messages import Ack, Health, Refused, SampleBatch
from protocol.wire.session import SessionConfig, open_session
from sitegrid.doctor import Finding, Level, skipped
from sitegrid.follower_choice import KNOWN_S
from sitegrid.security.join import signer
from sitegrid.trust_sentences import rolls

ANSWER_S = 5.0
LINK_S = 3.0
HEALTH_S = 3.0  # an agent reports every second
AHEAD_S = 60.0  # newest stamp ahead of the server's clock, beyond errors of setting by hand
OFFSET_S = 1.0  # clock offset beyond which the map's ages are wrong


# --- router ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RouterLink:
    """Link to the router. took_s: to open a session, None: failed. listens: accepts connections."""

    endpoint: str
    took_s: float | None
    listens: bool = False
    has_keys: bool = False


def open_link(config: SessionConfig) -> tuple[RouterLink, zenoh.Session | None]:
    """Open a session and describe the result."""
    has_keys = config.credentials is not None
    if not _listens(config.endpoint):  # Zenoh would retry until the timeout
        return RouterLink(config.endpoint, None, has_keys=has_keys), None
    start_s = time.perf_counter()
    try:
        session = open_session(config)
    except LinkError:
        return RouterLink(config.endpoint, None, listens=True, has_keys=has_keys), None
    return RouterLink(config.endpoint, time.perf_counter() - start_s, has_keys=has_keys), session


def _listens(endpoint: str) -> bool:
    """Whether an endpoint accepts TCP connections."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), LINK_S).close()
    except (OSError, ValueError, OverflowError):
        return False
    return True


def check_link(link: RouterLink) -> Finding:
    """Whether a session with the router opened."""
    if link.took_s is not None:
        return Finding(Level.PASS, "router", f"{link.endpoint} answers in {link.took_s * 1e3:.0f} ms")
    if not link.listens:
        advice = "start `sitegrid router`, or compare --endpoint, cables and firewalls"
        return Finding(Level.FAIL, "router", f"nothing listens at {link.endpoint}", advice)
    advice = "these keys may be of another site, outdated, or not those of its register" if link.has_keys else ""
    advice = advice or "if it asks for keys, pass --keys"
    return Finding(Level.FAIL, "router", f"{link.endpoint} takes connections, but lets this session not in", advice)


# --- map server ------------------------------------------------------------------------------------------------------


def ask_info(session: zenoh.Session, site: str) -> tuple[MapInfo | None, tuple[int, int]]:
    """The server's `info`, None without an answer; this host's clock before and after [ns].

    MessageError on unreadable answers.
    """
    before_ns = time.time_ns()
    data = _ask(session, keys.map_query(site, "info"), b"")
    asked_ns = (before_ns, time.time_ns())
    return (decode_info(data) if data else None), asked_ns


def ask_writers(session: zenoh.Session, site: str) -> list[MapInfo]:
    """Readable `info` of every map server of a site."""
    every: Any = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    servers = []
    for reply in session.get(keys.map_query(site, "info"), timeout=ANSWER_S, **every):
        with suppress(MessageError):
            servers += [decode_info(reply.ok.payload.to_bytes())] if reply.ok is not None else []
    return servers


def ask_machines(session: zenoh.Session, site: str) -> tuple[MachineState, ...]:
    """The server's view of the machines; empty without a readable answer."""
    data = _ask(session, keys.map_query(site, "machines"), b"")
    with suppress(MessageError):
        return decode_machines(data).machines if data else ()
    return ()


def check_machines(machines: Iterable[MachineState]) -> Finding:
    """Whether a machine's rolling resistance differs from others' on the same ground."""
    said = [f"{machine.name} {text}" for machine in machines if (text := rolls(machine))]
    message = "; ".join(said) or "none is known to roll unlike the others on the same ground"
    return Finding(Level.WARN if said else Level.PASS, "machines", message)


def check_writers(servers: list[MapInfo]) -> Finding:
    """Whether the site has exactly one writing map server."""
    names = [f"pid {info.server.pid} on host {info.server.host}, store {info.store}" for info in servers]
    if len(servers) == 1:
        return Finding(Level.PASS, "writer", names[0])
    if not servers:
        return skipped("writer", "no map server has answered a second time")
    problem = f"{len(servers)} map servers take samples of this site: {'; '.join(names)}"
    return Finding(Level.FAIL, "writer", problem, "stop all but one: each lacks what the others have")


def check_followers(followers: list[FollowerState], info: MapInfo) -> Finding:
    """Whether followers belong to the server's store, and their lag."""
    if not followers:
        return skipped("followers", "none answers; where readers are many, start `sitegrid follow`")
    if others := [one.name for one in followers if one.store != info.store]:
        problem = f"{', '.join(others)} has the map of another store than the map server, {info.store}"
        return Finding(Level.FAIL, "followers", problem, "start it with the --store and --journal of the server")
    worst = max(followers, key=lambda one: one.behind_s)
    if worst.behind_s > SHOWN_S:
        advice = "clients ask others meanwhile; look at its log, and at the load of its host"
        return Finding(Level.WARN, "followers", str(worst), advice)
    names = ", ".join(one.name for one in followers)
    return Finding(Level.PASS, "followers", f"{names}: at most {worst.behind_s:.1f} s behind")


def offset_of(info: MapInfo, asked_ns: tuple[int, int]) -> tuple[float, float]:
    """Lead of the host's clock over the server's, error bound [s]."""
    before_ns, after_ns = asked_ns
    return ((before_ns + after_ns) / 2 - info.wall_ns) * 1e-9, (after_ns - before_ns) / 2 * 1e-9


def check_server(site: str, info: MapInfo | None, *, is_there: bool, role: str = "") -> Finding:
    """Whether the map server answers. is_there: known to the router. role: of the keys."""
    if info is not None:
        text = f"site {site}: {info.samples_merged} samples in {info.cells} cells, journal row {info.journalled}"
        behind = f", merged only up to {info.merged}" if info.merged != info.journalled else ""
        return Finding(Level.PASS, "server", text + behind)
    if is_there:
        advice = "the router denies the question (see `sitegrid keys list`), or the server hangs"
        return Finding(Level.FAIL, "server", f"site {site}: a map server is there, but does not answer", advice)
    advice = "start `sitegrid server`, or compare the name of the site"
    if role:
        advice += "; or these keys are revoked, or not in its register, and it shows them nothing"
    return Finding(Level.FAIL, "server", f"site {site}: the router knows of no map server", advice)


def check_losses(info: MapInfo) -> Finding:
    """Recorded or acknowledged samples missing in the store."""
    parts = {
        "declared lost": {name: counts.lost for name, counts in info.machines.items() if counts.lost},
        "acknowledged and gone": {name: counts.missing for name, counts in info.machines.items() if counts.missing},
    }
    texts = [f"{what}: " + ", ".join(f"{n} of {name}" for name, n in by.items()) for what, by in parts.items() if by]
    texts += info.shortfalls[-1:]
    if count := info.counters.get(f"refused_{Refusal.SCATTERED}"):
        texts.append(f"quarantined: samples of {count} batches, on new ground that their machines had not driven for")
    if not texts:
        return Finding(Level.PASS, "losses", "no machine has lost samples, and the store none")
    advice = "look at the disks of machines and server, and at their logs; a backup may have what the store lacks"
    return Finding(Level.WARN, "losses", "; ".join(texts), advice)


def check_site(site: SiteConfig, info: MapInfo) -> Finding:
    """Whether a site file has the server's name and frame."""
    if (site.name, site.frame) == (info.site.name, info.site.frame):
        return Finding(Level.PASS, "site", f"{site.name}, frame {site.frame}, as the map server has it")
    problem = f"this is {site.name} with frame {site.frame}, the map server has {info.site.name} with {info.site.frame}"
    return Finding(Level.FAIL, "site", problem, "compare name and origin in the site files")


def check_clock(offset_s: float, error_s: float, site: SiteConfig | None) -> Finding:
    """Judge the host clock's lead. error_s: error bound."""
    ahead = "ahead of" if offset_s > 0 else "behind"
    message = f"{abs(offset_s):.2f} s {ahead} the map server's clock (+-{error_s:.2f} s)"
    advice = "set both clocks by NTP (chrony, systemd-timesyncd)"
    limit_s = site.clock_tolerance_s if site and site.clock == "wall" else math.inf
    if offset_s - error_s > limit_s:
        return Finding(Level.FAIL, "clock", f"{message}; samples are refused beyond {limit_s:g} s", advice)
    if abs(offset_s) - error_s > OFFSET_S:
        return Finding(Level.WARN, "clock", message, advice)
    return Finding(Level.PASS, "clock", message)


def check_time(info: MapInfo) -> Finding:
    """Whether machines' stamps fit the server's clock."""
    advice: dict[str, str] = {}  # by problem; counts last until a restart and must not hide others
    if (ahead_s := (info.stamp_ns - info.wall_ns) * 1e-9) > AHEAD_S:
        trusted = {name: counts for name, counts in info.machines.items() if name not in info.distrusted}
        newest = max(trusted, key=lambda name: trusted[name].newest_ns, default="?")
        problem = f"the site's now is {ahead_s / 3600:.1f} h ahead of the server's clock, by {newest}"
        advice[problem] = f"set the clock that is wrong; or `sitegrid distrust {newest}`"
    if count := info.counters.get(f"refused_{Refusal.SERVER_CLOCK}"):
        problem = f"the map server refused {count} batches since its own clock is behind what it has seen"
        advice[problem] = "set the server's clock; machines wait, and keep their samples"
    if count := info.counters.get(f"refused_{Refusal.FAR_FUTURE}"):
        problem = f"{count} batches were refused for stamps more than a day ahead; these samples are quarantined"
        advice[problem] = "the server's log names the machine: set its clock"
    if advice:
        return Finding(Level.WARN, "time", "; ".join(advice), "; ".join(advice.values()))
    return Finding(Level.PASS, "time", "no stamp is ahead of the map server's clock")


def check_version(own: str, other: str) -> Finding:
    """Whether both sides have one version; others may work, since the wire has its own version."""
    if UNKNOWN in (own, other):
        return skipped("version", f"here {own}, map server {other}: one of them runs without being installed")
    if own == other:
        return Finding(Level.PASS, "version", f"{own} on both sides")
    return Finding(Level.WARN, "version", f"here {own}, map server {other}", "update the older side")


# --- machines --------------------------------------------------------------------------------------------------------


def ask_permission(
    session: zenoh.Session, site: str, machine: str, frame: str, folder: Path | None
) -> Ack | Refused | None:
    """Send an empty batch of a random spool; its watermark leaves no trace (docs/protocol.md).

    folder: of the machine's keys; signed if they include a signature key.
    """
    key = keys.ingest(site, machine)
    batch = encode_batch(SampleBatch(machine, secrets.randbits(64) or 1, 1, empty(), frame))
    try:
        data = _ask(session, key, batch, signing.sign(key, batch) if (signing := signer(folder)) else None)
        return decode_reply(data) if data else None
    except MessageError as error:
        return Refused(error.reason, f"its answer cannot be read: {error}")


def check_permission(machine: str, answer: Ack | Refused | None, *, is_there: bool, has_keys: bool) -> Finding:
    """Whether a machine's batches are accepted, judged by the answer to an empty one."""
    if isinstance(answer, Ack):
        return Finding(Level.PASS, "permission", f"batches of {machine} are taken")
    if isinstance(answer, Refused):
        problem = f"the map server refuses batches of {machine} ({answer.reason}): {answer.problem}"
        return Finding(Level.FAIL, "permission", problem)
    if not is_there:
        problem = f"nobody takes batches of {machine}"
        return Finding(Level.FAIL, "permission", problem, "start `sitegrid server`, or compare the name of the site")
    problem = f"a map server is there, but gives no answer to batches of {machine}"
    denied = "the router denies it: a machine may send under the name of its keys alone"
    advice = denied if has_keys else "the router denies it, or the server hangs"
    return Finding(Level.FAIL, "permission", problem, advice)


def receive_health(session: zenoh.Session, site: str, machine: str) -> Health | None:
    """A running agent's health report; None if missing or unreadable."""
    with session.declare_subscriber(keys.health(site, machine), zenoh.handlers.RingChannel(1)) as subscriber:
        end_s = time.monotonic() + HEALTH_S
        while not (sample := subscriber.try_recv()):
            if time.monotonic() >= end_s:
                return None
            time.sleep(0.05)
    try:
        return decode_health(sample.payload.to_bytes())
    except MessageError:
        return None


def _ask(session: zenoh.Session, key: str, payload: bytes, attachment: bytes | None = None) -> bytes | None:
    """The answer, or None. A new server may not be visible yet, hence brief retries."""
    end_s = time.monotonic() + KNOWN_S
    while True:
        for reply in session.get(key, payload=payload, attachment=attachment, timeout=ANSWER_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        if time.monotonic() > end_s:
            return None
        time.sleep(KNOWN_S / 10)
