"""The main job in real processes: driving machines, one growing grid, kills of everyone."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import zenoh

from protocol.queries.answers import MapInfo, Region
from protocol.queries.requests import PointQuery
from protocol.wire import keys
from protocol.wire.codec import decode_pose
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid.client import Client
from sitegrid.process.children import Child
from sitegrid.proof.delivery import AuditResult
from tests.command_lines import said
from tests.integration.forks import Forks
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes


@dataclass(frozen=True)
class Kill:
    """Process ids and merged samples before a kill and after the restart."""

    pids: tuple[int, int]
    merged: tuple[int, int]


@dataclass(frozen=True)
class Shift:
    """Three driving machines while server, agent and router are killed in turn."""

    pids: list[int]
    during: MapInfo
    kills: dict[str, Kill]
    info: MapInfo
    region: Region
    audit: AuditResult


@pytest.fixture(scope="module")
def shift(tmp_path_factory: pytest.TempPathFactory) -> Shift:
    folder = tmp_path_factory.mktemp("shift")
    with Forks(folder) as children:
        sim = SimConfig(machines=3, seconds=0, speed=8, seed=3, world="fast")
        run = SiteRun(folder, children, free_endpoint(), sim)
        router, server, driving = run.start()
        agent = run.agents[run.configs[0].stem]
        pids = [child.pid for child in (router, server, driving, *run.agents.values())]
        with run.connect() as client:
            run.wait_merged(client, 60)
            during = client.info()
            assert client.ask(PointQuery(0.0, 0.0, after=during.journalled)).merged >= during.journalled
            kills = {
                "server": killed(client, server, run.start_server),
                "agent": killed(client, agent, lambda: run.start_agent(run.configs[0]), agent.name),
                "router": killed(client, router, run.start_router),
            }
            drive_on(client, run)
            driving.send(signal.SIGTERM)  # machines end with it
            run.delivered()
            info, region = client.info(), client.region((0, 0, 200, 150), ["resistance", "visits"])
        assert run.server.stop() == 0
        return Shift(pids, during, kills, info, region, run.audit())


def drive_on(client: Client, run: SiteRun) -> None:
    """Wait until all machines hear the simulator, which announces its end once."""
    first_ns, newest_ns = dict[str, int](), dict[str, int]()

    def note(sample: zenoh.Sample) -> None:
        machine = keys.machine_of(str(sample.key_expr))
        newest_ns[machine] = decode_pose(sample.payload.to_bytes()).stamp_ns
        first_ns.setdefault(machine, newest_ns[machine])

    subscriber = client.session.declare_subscriber(keys.poses_all(run.site), note)
    until(
        lambda: len(first_ns) == 3 and all(newest_ns[name] > ns + 10**10 for name, ns in first_ns.items()),
        "poses of all machines",
    )
    subscriber.undeclare()


def killed(client: Client, victim: Child, start: Callable[[], Child], machine: str = "") -> Kill:
    """Kill and restart a process; samples continue (of `machine`, if its agent was killed)."""

    def merged() -> int:
        info = client.info()
        if not machine:
            return info.samples_merged
        return info.machines[machine].samples if machine in info.machines else 0  # it may be the last with samples

    before = merged()
    kill(victim)
    again = start()
    until(lambda: merged() > before, f"samples after the kill of {victim.name}")
    return Kill((victim.pid, again.pid), (before, merged()))


def test_several_machines_merge_into_one_grid(shift: Shift):
    assert len({*shift.pids, os.getpid()}) == 7
    assert len(shift.info.machines) == 3
    assert shift.info.samples_merged > shift.during.samples_merged >= 60
    known = np.isfinite(shift.region["resistance"])
    assert known.sum() > 500
    assert np.nanmax(shift.region["visits"]) >= 1
    assert np.isnan(shift.region["visits"][~known]).any()


@pytest.mark.parametrize("victim", ["server", "agent", "router"])
def test_a_process_killed_in_mid_run_loses_nothing(shift: Shift, victim: str):
    kill = shift.kills[victim]
    assert kill.pids[0] != kill.pids[1]
    assert kill.merged[0] < kill.merged[1] < shift.info.samples_merged + 1
    assert (shift.audit.lost, shift.audit.double, shift.audit.unrecorded) == (0, 0, 0)
    assert shift.audit.recorded == shift.audit.merged > 300


@pytest.mark.nightly
def test_an_agent_runs_on_without_a_router_and_catches_up(site_run: SiteRun, children: Forks, tmp_path):
    recording = ("--record", tmp_path / "logs", "--seconds", 60, "--machines", 1, "--world", "fast")
    assert said("sim", *recording).code == 0
    log, spool = tmp_path / "logs" / "loader-1", tmp_path / "loader-1.db"
    files = ("--spool", spool, "--audit", tmp_path / "loader-1.audit")
    words = ("--endpoint", site_run.endpoint, "--driver", "replay", "--log", log, "--speed", "0")
    agent = children.start("loader-1", "agent", *words, "--site-file", site_run.site_file, *files, "--json")
    agent.expect("ready", PATIENCE_S)
    audit = tmp_path / "loader-1.audit"
    until(lambda: audit.exists() and audit.read_text().count("\n") > 100, "samples recorded offline")
    assert agent.code is None
    site_run.start_router()
    server = site_run.start_server()
    report = agent.expect("ended", PATIENCE_S)["ended"]
    assert report["delivered"]
    assert report["uplink"]["counters"].get("unanswered", 0) > 0, "it noticed that nobody answered"
    server.stop()
    site_run.configs = [tmp_path / "loader-1.toml"]
    result = site_run.audit()
    assert (result.lost, result.double) == (0, 0)
    assert result.recorded > 100
