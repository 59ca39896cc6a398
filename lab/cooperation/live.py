"""One arm, live: a router, a map server, and an agent per machine that replays its log, each a process of its own.

Every agent has a link of its own, a proxy on loopback, which counts what it carries. Logs are replayed faster than they
were recorded: outages and rates of links, and the seconds between two audits of the server, are shortened alike.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.campaign.experiment import Experiment, Task
from lab.cooperation.arms import Arm, Link, logs_of
from lab.cooperation.drives import SharedDrive
from lab.cooperation.processes import Process, Processes
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
        processes = opened.enter_context(Processes(folder))
        port = _serve(processes, folder, logs, arm.speed)
        links = [opened.enter_context(Proxy(port)) for _ in logs]
        agents = [
            processes.start(name, *_agent(folder, name, log, link, arm.speed))
            for (name, log), link in zip(logs.items(), links, strict=True)
        ]
        ending = threading.Event()
        watch = threading.Thread(target=_keep_weather, args=(arm.link, links, agents, arm.speed, ending), daemon=True)
        watch.start()
        opened.callback(watch.join)
        opened.callback(ending.set)
        for agent in agents:
            agent.expect("ready", READY_S)
        took_s = arm.seconds / arm.speed
        reports = [agent.expect("ended", took_s + LATE_S) for agent in agents]
        late_s = max(agent.seen_s["ended"] - agent.seen_s["ready"] for agent in agents) - took_s
        pids = {name: process.pid for name, process in processes.all.items()}
        processes.close()
        ending.set()
        rows, events = _journal(folder / "store")
        began_s = {agent.name: agent.seen_s["ready"] for agent in agents}
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


def _serve(processes: Processes, folder: Path, logs: dict[str, Path], speed: float) -> int:
    """Start router and map server; returns the router's port."""
    endpoint = free_endpoint()
    site = open_log(next(iter(logs.values()))).site
    (folder / "site.toml").write_text(site_toml(site), encoding="utf-8")
    options = {"judge_s": TrustConfig().judge_s / speed}
    lines = ["[store]", "archive_after_h = 0.0", "[trust]", *toml_lines(options)]  # stamps of logs are of another day
    (folder / "server.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    processes.start("router", "router", "--listen", endpoint).expect("ready", READY_S)
    files = ("--site-file", folder / "site.toml", "--config", folder / "server.toml", "--store", folder / "store")
    processes.start("server", "server", "--endpoint", endpoint, *files).expect("ready", READY_S)
    return int(endpoint.rpartition(":")[2])


def _agent(folder: Path, name: str, log: Path, link: Proxy, speed: float) -> Sequence[object]:
    source = ("--driver", "replay", "--log", log, "--speed", speed)
    return ("agent", "--endpoint", link.endpoint, *source, "--spool", folder / f"{name}.db", "--json")


def _keep_weather(
    link: Link, links: Sequence[Proxy], agents: Sequence[Process], speed: float, ending: threading.Event
) -> None:
    """Have each link's weather follow its agent's time, from its start on."""
    while not ending.wait(STEP_S):
        for turn, (proxy, agent) in enumerate(zip(links, agents, strict=True)):
            if not (began_s := agent.seen_s.get("ready")):
                continue
            weather = link.weather(turn, (time.time() - began_s) * speed, speed)
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
