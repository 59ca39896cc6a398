"""A whole fleet at one map server: acknowledgement times, cost, capacity.

Also one agent's link in real time: TCP bytes with Zenoh's framing, acknowledgements and keep-alives; TLS and TCP/IP
headers come on top.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from lab.speed.measure import ROOT, Figures, in_child, rows_of
from lab.speed.site import READY_S, SESSIONS, SITE, Machine, Site, fleet, send_all, session, settle, used
from mapserver.journal.archive import write_file
from mapserver.journal.location import JournalLocation
from protocol.site.site_file import load_site
from protocol.wire import keys
from sitegrid.process.children import wait_until
from sitegrid.proof.figures import Row
from tests.memory import memory_mb
from tests.site_work import BATCH, HOURS, START_NS, samples_of, write_store
from tests.tcp_proxy import Proxy

OPTIONS = {"machines": 500, "seconds": 70.0, "hours": HOURS}
LOADS = {"paced": 1.0, "saturated": 0.0}  # seconds between batches of a machine
GOALS = {
    ("paced", "refused"): "<= 0",
    ("paced", "ack_ms_p99"): "<= 150",
    ("paced", "server_cores"): "<= 0.6",
    ("paced", "disk_mb_per_s"): "<= 7",
    ("saturated", "samples_per_s"): ">= 25000",
}
SITE_FILE = ROOT / "config" / "site.toml"
LAG_S = 100.0  # from a place to its sample, before regular traffic
SPEED = 1.0  # of the agent's drive: health and acknowledgements follow the clock


def run(machines: int, seconds: float, hours: float) -> Iterator[Row]:
    """A fleet against a server with `hours` of work, paced, then saturated.

    Acknowledged samples per second, refused batches, milliseconds to acknowledgement, cores and peak memory of server
    and router, server's disk writes. Agent: link bytes and samples per second; compressed archive bytes per sample,
    from a real drive because synthetic samples compress better.
    """
    with tempfile.TemporaryDirectory() as path, Site(Path(path)) as site, ExitStack() as opened:
        links = [opened.enter_context(session(site.endpoint)) for _ in range(min(machines, SESSIONS))]
        senders = fleet(links, machines)
        write_store(Path(path), SITE, samples_of(hours) // BATCH, 0, known=[one.name for one in senders])
        server = opened.enter_context(site.serving())
        settle(server)
        for name, period_s in LOADS.items():
            yield from rows_of(name, _measured(server, site.router, senders, seconds, period_s))
    with tempfile.TemporaryDirectory() as path:
        yield from rows_of("agent", _agent_link(Path(path), seconds))


def _measured(server: int, router: int, senders: list[Machine], seconds: float, period_s: float) -> Figures:
    written = _written_bytes(server)
    with used(server, router) as cores:
        sent = send_all(senders, seconds, period_s)
    return {
        **sent.figures,
        "server_cores": cores[0],
        "router_cores": cores[1],
        "server_mb": memory_mb("VmHWM", server),
        "router_mb": memory_mb("VmHWM", router),
        "disk_mb_per_s": (_written_bytes(server) - written) / sent.took_s / 1e6,
    }


def _written_bytes(process: int) -> int:
    """Bytes a process wrote to disk."""
    lines = Path(f"/proc/{process}/io").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("write_bytes"))


def _agent_link(folder: Path, seconds: float) -> Figures:
    """An agent replaying a simulated drive, with subscribers to pose and health, which are else not sent."""
    log, store, config = folder / "log", folder / "store", load_site(SITE_FILE)
    store.mkdir()
    words = ("--record", log, "--machines", 1, "--seconds", SPEED * seconds + 1.5 * LAG_S, "--speed", 0, "--json")
    in_child("sitegrid.cli", "sim", *map(str, words))
    with ExitStack() as opened:
        site = opened.enter_context(Site(store, config))
        opened.enter_context(site.serving())
        link = opened.enter_context(Proxy(int(site.endpoint.rpartition(":")[2])))
        listener = opened.enter_context(session(site.endpoint))
        for key in (keys.poses_all(config.name), keys.health_all(config.name)):
            listener.declare_subscriber(key, lambda _: None)
        replay = ("--driver", "replay", "--log", log / "loader-1" / "log.toml", "--speed", SPEED)
        site.start("agent", "agent", "--endpoint", link.endpoint, "--spool", folder / "spool.db", *replay)
        wait_until(lambda: _acknowledged(store) > 0, READY_S, "the first sample of an agent")
        before, began_s = (link.carried("there"), link.carried("back"), _acknowledged(store)), time.monotonic()
        time.sleep(seconds)
        after, took_s = (link.carried("there"), link.carried("back"), _acknowledged(store)), time.monotonic() - began_s
    up, down, rate = ((now - then) / took_s for now, then in zip(after, before, strict=True))
    return {"up_b_per_s": up, "down_b_per_s": down, "samples_per_s": rate, "archive_b_per_sample": _archived(store)}


def _acknowledged(store: Path) -> int:
    with JournalLocation(store).reader() as journal:
        return sum(mark.seq for mark in journal.watermarks().values())


def _archived(store: Path) -> float:
    """Bytes per sample of a journal archived as one file."""
    location = JournalLocation(store)
    with location.reader() as journal:
        rows = ((row, START_NS) for row in journal.read())
        path = write_file(location.archive.folder, journal.identity().id, SITE, rows)
    if path is None:
        raise RuntimeError("the journal is empty: nothing was measured")
    return path.stat().st_size / _acknowledged(store)
