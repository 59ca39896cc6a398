"""Faults that meet samples which wait for the smoother: agents killed with a full window, sensors that fall silent."""

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

FAST = 8.0  # times real time: a window of 90 s is full after a quarter of a minute
STRIKES = 4  # of the whole suite: how often all agents are killed
LEAST_PENDING = 200  # samples in a full window, at least: 90 s at 2 m/s have 360


def window(scenario: FaultRun) -> FaultOutcome:
    """Kill -9 of all agents, each with a minute and a half of samples that wait for the smoother."""
    strikes = scenario.strikes or max(2, round(STRIKES * scenario.scale))
    with _site(scenario) as site:
        site.start_all()
        pending: list[int] = []
        for _ in range(strikes):
            site.wait_runs()  # the first samples of every run have come: it has as many behind them as the lag holds
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
    """Machines that drive, and are then parked with their sensors off, agents and all: nothing stays with them."""
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
    """Samples in the spool that a killed agent has left, of which nothing is changed."""
    folder = site.folder / "copy"
    folder.mkdir()
    for path in (site.folder / "spool").glob(f"{machine}.db*"):
        shutil.copy(path, folder / path.name)
    with closing(Spool(folder / f"{machine}.db", SpoolConfig())) as spool:
        depth = spool.counters()["depth"]
    shutil.rmtree(folder)
    return depth
