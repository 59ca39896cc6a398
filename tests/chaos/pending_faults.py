"""Faults with samples pending in the smoother: agents killed with a full window, silent sensors."""

from __future__ import annotations

import shutil
from contextlib import closing

from agents.agent import SILENT_S
from agents.delivery.spool import Spool, SpoolConfig
from agents.localisation.localiser import LocalisationConfig
from tests.chaos.chaos_site import ChaosSite
from tests.chaos.outcome import FaultOutcome
from tests.chaos.recordings import PARKED, SECONDS
from tests.chaos.scenario import FaultRun

FAST = 8.0  # real time factor: a 90 s window fills in 15 s
STRIKES = 4  # kills of all agents, in the whole suite
LEAST_PENDING = 200  # in a full window: 90 s at 2 m/s have 360


def window(scenario: FaultRun) -> FaultOutcome:
    """Kill -9 all agents, each with 90 s of pending samples."""
    strikes = scenario.strikes or max(2, round(STRIKES * scenario.scale))
    with _site(scenario) as site:
        site.start_all()
        pending: list[int] = []
        for _ in range(strikes):
            site.wait_runs()  # each run's first samples are journalled, so its window is full
            for machine in site.machines:
                with site.fault():
                    site.put_down(machine)
                    pending.append(_waiting(site, machine))
                    site.start(machine)
            scenario.say(f"agents killed with {pending[-len(site.machines) :]} samples in their spools")
        outcome = site.finish(scenario.fault, len(pending))
        outcome.notes["fewest pending at a kill"] = min(pending)
        if min(pending) < LEAST_PENDING:
            site.problem(f"an agent was killed with {min(pending)} samples in its spool: its window was not full")
        return outcome


def parked(scenario: FaultRun) -> FaultOutcome:
    """Machines drive, then park with sensors and agents off: no sample stays behind."""
    with _site(scenario) as site:
        site.variant = PARKED
        site.start_all()
        drive_s = SECONDS / FAST
        site.linger(drive_s + SILENT_S)
        site.wait_delivered()
        site.outcome.notes["delivered while parked"] = dict(site.progress())
        if not all(site.progress().get(machine, 0) > LEAST_PENDING for machine in site.machines):
            site.problem(f"parked machines have delivered {dict(site.progress())}")
        site.variant = ""
        for machine in site.machines:
            site.kill(machine)
        return site.finish(scenario.fault, len(site.machines))


def _site(scenario: FaultRun) -> ChaosSite:
    site = scenario.site()
    site.set_lag(LocalisationConfig().lag_s)
    site.speed = FAST
    return site


def _waiting(site: ChaosSite, machine: str) -> int:
    """Samples in a killed agent's spool, read from a copy."""
    folder = site.folder / "copy"
    folder.mkdir()
    for path in (site.folder / "spool").glob(f"{machine}.db*"):
        shutil.copy(path, folder / path.name)
    with closing(Spool(folder / f"{machine}.db", SpoolConfig())) as spool:
        depth = spool.counters()["depth"]
    shutil.rmtree(folder)
    return depth
