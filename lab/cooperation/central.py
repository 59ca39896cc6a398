"""The same machines with a perfect link: one process gets all readings at once, runs all pipelines, and folds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from agents.localisation.localiser import LocalisationConfig
from lab.calibration import drives
from lab.calibration.drives import Agent, AgentSamples
from lab.calibration.solving import accused, calibrated, of_machine
from lab.campaign.experiment import Task, read_result, replay_task
from lab.cooperation.arms import Arm
from lab.cooperation.maps import Timeline
from mapserver.fleet.correction import Corrections
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.upkeep.calibrating import EVERY_NS
from protocol.arrays import Ints, Table
from sim.simulator import START_NS

LAG_NS = round(LocalisationConfig().lag_s * 1e9)  # of the smoother: samples are final then, wherever it runs


def central_tasks(arm: Arm, seed: int) -> list[Task[Agent]]:
    """The pipelines of an arm's machines, as agents have them by default."""
    drive = arm.drive(seed)
    order = sorted(drive.machines)  # as the log folders lie
    return [replay_task(Agent(order.index(name), closed_tours=True), drive) for name in arm.names(drive)]


def central_timeline(arm: Arm, seed: int, cache: Path, *, arrived: bool) -> Timeline:
    """What such a process has, by stamps or by when samples are final; it judges and calibrates once a minute."""
    names = arm.names(arm.drive(seed))
    rows = {
        name: read_result(AgentSamples, drives.EXPERIMENT.file(task, cache)).samples
        for name, task in zip(names, central_tasks(arm, seed), strict=True)
    }
    end_ns = START_NS + round(arm.seconds * 1e9)
    samples = np.concatenate(list(rows.values()))
    stamps = samples["stamp_ns"].astype(np.int64)
    time_ns = np.minimum(stamps + LAG_NS, end_ns) if arrived else stamps
    order = np.argsort(time_ns, kind="stable")
    machine: Ints = np.repeat(np.arange(len(rows)), [len(table) for table in rows.values()])
    facts = [(0, NO_FACTS)]
    for now_ns in range(START_NS + EVERY_NS, end_ns + 1, EVERY_NS):
        there = {name: table[table["stamp_ns"] <= now_ns - arrived * LAG_NS] for name, table in rows.items()}
        facts.append((now_ns, decided({name: table for name, table in there.items() if len(table)})))
    return Timeline(samples[order], machine[order], names, time_ns[order], tuple(facts))


def decided(rows: Mapping[str, Table]) -> Facts:
    """What the server's trust and calibration come to on samples."""
    if not rows:
        return NO_FACTS
    bad = accused(rows, calibrated(rows))
    result = calibrated(rows, bad)
    own = [each for name in rows if name not in bad for each in of_machine(result, name)]
    return Facts(frozenset(bad), Corrections(own))
