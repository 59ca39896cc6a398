"""One arm, live: router, map server, and an agent per machine replaying its log, a process each.

Every agent's link is a counting proxy on loopback. Replays are faster than recorded; outages, link rates and the
server's audit interval scale alike.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.campaign.experiment import Experiment, Task
from lab.campaign.workers import ONE_THREAD, environment
from lab.cooperation.drives import Arm, Link, SharedDrive, logs_of
from mapserver.config import TrustConfig
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import JournalRow
from protocol.arrays import Ints, Table
from protocol.config import toml_lines
from protocol.machine.log_folder import open_log
from protocol.machine.samples import joined
from protocol.site.site_config import site_toml
from protocol.wire.session import free_endpoint
from sim.simulator import START_NS
from sitegrid.process.children import Child, Children
from tests.tcp_proxy import Proxy

READY_S = 600.0  # a first start compiles kernels: minutes on a busy host
STEP_S = 0.05  # between updates of a link's quality
LATE_S = 120.0  # beyond a replay's length: host load, and the agent's wait for last replies


@dataclass(frozen=True)
class LiveRun:
    """Result of one arm.

    samples (n,): in journal order; machine (n,): index in `machines`; arrived_ns (n,): arrival in the journal, log
    time. events: of the journal, plain values. sent_bytes, received_bytes: by link. delivered: everything acknowledged
    at the end. late_s: excess time of the replay, log time. pids: by process name.
    """

    samples: Table
    machine: Ints
    arrived_ns: Ints
    machines: list[str]
    events: list[dict[str, Any]]
    sent_bytes: list[int]
    received_bytes: list[int]
    delivered: bool
    late_s: float
    pids: dict[str, int]


def run(arm: Arm, drive: SharedDrive, cache: Path) -> LiveRun:
    """Run an arm on a cached recording; SitegridError if a process fails."""
    with tempfile.TemporaryDirectory() as path, ExitStack() as opened:
        folder = Path(path)
        logs = dict(logs_of(arm, drive, cache, folder))
        opened.enter_context(environment(ONE_THREAD))
        processes = opened.enter_context(Children(logs_folder(cache)))
        port, pids = _serve(processes, folder, logs, arm.speed)
        links = [opened.enter_context(Proxy(port)) for _ in logs]
        agents = [
            processes.start(name, *_agent(folder, name, log, link, arm.speed))
            for (name, log), link in zip(logs.items(), links, strict=True)
        ]
        began_s: dict[str, float] = {}
        ending = threading.Event()
        weather = (arm.link, dict(zip(logs, links, strict=True)), began_s, arm.speed, ending)
        watch = threading.Thread(target=_keep_weather, args=weather, daemon=True)
        watch.start()
        opened.callback(watch.join)
        opened.callback(ending.set)
        took_s = arm.seconds / arm.speed
        with ThreadPoolExecutor(len(agents)) as pool:
            reports = list(pool.map(lambda agent: _replayed(agent, began_s, took_s), agents))
        late_s = max(report["took_s"] for report in reports) - took_s
        pids |= {agent.name: agent.pid for agent in agents}
        processes.close()
        ending.set()
        rows, events = _journal(folder / "store")
        return LiveRun(
            samples=joined([row.rows for row in rows]),
            machine=_repeated([list(logs).index(row.machine) for row in rows], rows),
            arrived_ns=arrivals(rows, began_s, arm.speed),
            machines=list(logs),
            events=events,
            sent_bytes=[link.carried("there") for link in links],
            received_bytes=[link.carried("back") for link in links],
            delivered=all(report["delivered"] for report in reports),
            late_s=max(0.0, late_s * arm.speed),
            pids=pids,
        )


def logs_folder(cache: Path) -> Path:
    """Folder of process logs, for diagnosis."""
    folder = cache / "cooperation-logs"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _serve(processes: Children, folder: Path, logs: dict[str, Path], speed: float) -> tuple[int, dict[str, int]]:
    """Start router and map server; returns the router's port and process ids."""
    endpoint = free_endpoint()
    site = open_log(next(iter(logs.values()))).site
    (folder / "site.toml").write_text(site_toml(site), encoding="utf-8")
    options = {"judge_s": TrustConfig().judge_s / speed}
    lines = ["[store]", "archive_after_h = 0.0", "[trust]", *toml_lines(options)]  # the logs' stamps are days old
    (folder / "server.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    router = processes.start("router", "router", "--listen", endpoint)
    router.expect("ready", READY_S)
    files = ("--site-file", folder / "site.toml", "--config", folder / "server.toml", "--store", folder / "store")
    server = processes.start("server", "server", "--endpoint", endpoint, *files)
    server.expect("ready", READY_S)
    return int(endpoint.rpartition(":")[2]), {"router": router.pid, "server": server.pid}


def _agent(folder: Path, name: str, log: Path, link: Proxy, speed: float) -> Sequence[str | Path | float]:
    source = ("--driver", "replay", "--log", log, "--speed", speed)
    return ("agent", "--endpoint", link.endpoint, *source, "--spool", folder / f"{name}.db", "--json")


def _replayed(agent: Child, began_s: dict[str, float], took_s: float) -> dict[str, Any]:
    """Wait for an agent's end; returns its last line and `took_s` since ready. began_s: receives that time."""
    agent.expect("ready", READY_S)
    began_s[agent.name] = time.time()
    return {**agent.expect("ended", took_s + LATE_S)["ended"], "took_s": time.time() - began_s[agent.name]}


def _keep_weather(
    link: Link, links: Mapping[str, Proxy], began_s: Mapping[str, float], speed: float, ending: threading.Event
) -> None:
    """Update each link's quality by its agent's time."""
    while not ending.wait(STEP_S):
        for turn, (name, proxy) in enumerate(links.items()):
            if name not in began_s:
                continue
            weather = link.weather(turn, (time.time() - began_s[name]) * speed, speed)
            if weather != proxy.weather:
                proxy.set(weather)


def arrivals(rows: Sequence[JournalRow], began_s: Mapping[str, float], speed: float) -> Ints:
    """Arrival of samples in the journal (n,), in log time; began_s: start of each log."""
    return _repeated([START_NS + round((row.received_ns - began_s[row.machine] * 1e9) * speed) for row in rows], rows)


def _repeated(values: Sequence[int], rows: Sequence[JournalRow]) -> Ints:
    """One value per row to one per sample."""
    return np.repeat(np.array(values, np.int64), [len(row.rows) for row in rows])


def _journal(store: Path) -> tuple[list[JournalRow], list[dict[str, Any]]]:
    with JournalLocation(store).reader() as journal:
        rows = list(journal.read())
        events = [{"id": e.id, "kind": e.kind, "stamp_ns": e.stamp_ns, "body": dict(e.body)} for e in journal.events()]
    return rows, events


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[Arm], cache: Path) -> LiveRun:
    return run(task.variant, task.variant.drive(task.seed), cache)


EXPERIMENT = Experiment("cooperation", LiveRun, _solve, also=("sitegrid.commands.agent", "sitegrid.commands.server"))
