"""One arm, live: a router, a map server, and an agent per machine that replays its log, each a process of its own.

Every agent has a link of its own, a proxy on loopback, which counts what it carries. Logs are replayed faster than they
were recorded: outages and rates of links, and the seconds between two audits of the server, are shortened alike.
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

READY_S = 600.0  # a first start compiles kernels: minutes on a busy machine
STEP_S = 0.05  # of a link's weather, and between two looks at it
LATE_S = (
    120.0  # beyond the length of a replay: a busy machine, and the time in which an agent waits for its last replies
)


@dataclass(frozen=True)
class LiveRun:
    """What came of one arm.

    samples (n,): of the journal, in its order; machine (n,): index of each one's in `machines`; arrived_ns (n,): when
    it was in the journal, in the log's time. events: of the journal, in plain values. sent_bytes, received_bytes: by
    each machine's link. delivered: whether agents had all acknowledged in the end. late_s: by how much the replay took
    longer than it should, in seconds of the log. pids: process ids, by name.
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
    """Run an arm on a recording that is in the cache; SitegridError where a process fails."""
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
    """Where processes log, so that one that failed can be looked into."""
    folder = cache / "cooperation-logs"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _serve(processes: Children, folder: Path, logs: dict[str, Path], speed: float) -> tuple[int, dict[str, int]]:
    """Start router and map server; returns the router's port, and process ids."""
    endpoint = free_endpoint()
    site = open_log(next(iter(logs.values()))).site
    (folder / "site.toml").write_text(site_toml(site), encoding="utf-8")
    options = {"judge_s": TrustConfig().judge_s / speed}
    lines = ["[store]", "archive_after_h = 0.0", "[trust]", *toml_lines(options)]  # stamps of logs are of another day
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
    """Wait for an agent's end; its last line, and `took_s`, from when it was ready. began_s: is told when that was."""
    agent.expect("ready", READY_S)
    began_s[agent.name] = time.time()
    return {**agent.expect("ended", took_s + LATE_S)["ended"], "took_s": time.time() - began_s[agent.name]}


def _keep_weather(
    link: Link, links: Mapping[str, Proxy], began_s: Mapping[str, float], speed: float, ending: threading.Event
) -> None:
    """Have each link's weather follow its agent's time, from its start on."""
    while not ending.wait(STEP_S):
        for turn, (name, proxy) in enumerate(links.items()):
            if name not in began_s:
                continue
            weather = link.weather(turn, (time.time() - began_s[name]) * speed, speed)
            if weather != proxy.weather:
                proxy.set(weather)


def arrivals(rows: Sequence[JournalRow], began_s: Mapping[str, float], speed: float) -> Ints:
    """When samples were in the journal (n,), in the time of their machines' logs, which began at these times."""
    return _repeated([START_NS + round((row.received_ns - began_s[row.machine] * 1e9) * speed) for row in rows], rows)


def _repeated(values: Sequence[int], rows: Sequence[JournalRow]) -> Ints:
    """A value per row as one per sample."""
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
