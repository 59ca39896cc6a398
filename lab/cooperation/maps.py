"""The map of one arm as it was at any time, made of its journal, or of what one process with a perfect link has.

What the server decided about machines counts from when it decided it, so that a map of an early minute is what the
server knew then. (Asked for the past, a map server corrects its samples by what it knows now; `decided` does that.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.localisation.localiser import LocalisationConfig
from lab.calibration import drives
from lab.calibration.drives import Agent, AgentSamples
from lab.calibration.solving import accused, calibrated, of_machine
from lab.campaign.experiment import Task, read_result, replay_task
from lab.cooperation.drives import Arm
from lab.cooperation.live import LiveRun
from lab.cooperation.network import LAYERS
from lab.maps.cases import CELL_M
from mapserver.calibration.correction import SampleCorrections
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import FoldConfig, name_hash
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import Decisions
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.rows import Event
from mapserver.query.views import read_cells, view_of
from mapserver.upkeep.calibrating import EVERY_NS
from protocol.arrays import Floats32, Ints, Table
from protocol.site.geometry import CellWindow
from sim.simulator import START_NS

Layers = Mapping[str, Floats32]
LAG_NS = round(LocalisationConfig().lag_s * 1e9)  # of the smoother: samples are final then, wherever it runs


@dataclass(frozen=True)
class Timeline:
    """Samples (n,) in the order in which they were there, time_ns (n,); machine (n,): each one's index in `machines`.

    facts: what was decided about machines, and from when on; the first from the beginning.
    """

    samples: Table
    machine: Ints
    machines: tuple[str, ...]
    time_ns: Ints
    facts: tuple[tuple[int, Facts], ...]

    @classmethod
    def of_run(cls, run: LiveRun, *, arrived: bool = False, decided: bool = False) -> Timeline:
        """What an arm left. arrived: by arrival, not by stamps. decided: all decisions count from the begin."""
        stamps = run.samples["stamp_ns"].astype(np.int64)
        time_ns = run.arrived_ns if arrived else stamps
        order = np.argsort(time_ns, kind="stable")
        facts = facts_of(run.events)
        if decided:
            facts = ((0, facts[-1][1]),)
        elif arrived:  # the site's now is the newest stamp that has arrived
            now_ns, at_ns = np.maximum.accumulate(stamps[order]), time_ns[order]
            facts = tuple((_when(now_ns, at_ns, from_ns), each) for from_ns, each in facts)
        return cls(run.samples[order], run.machine[order], tuple(run.machines), time_ns[order], facts)

    def of_machines(self, names: Iterable[str]) -> Timeline:
        """Of some machines' samples alone."""
        numbers = [self.machines.index(name) for name in names]
        chosen = np.isin(self.machine, numbers)
        return Timeline(self.samples[chosen], self.machine[chosen], self.machines, self.time_ns[chosen], self.facts)

    def by_machine(self, names: Iterable[str]) -> dict[str, Table]:
        """The samples of each of some machines."""
        return {name: self.samples[self.machine == self.machines.index(name)] for name in names}

    def facts_at(self, time_ns: int) -> Facts:
        """What was decided by then."""
        return [each for from_ns, each in self.facts if from_ns <= time_ns][-1]

    def maps(self, times_ns: Iterable[int], window: CellWindow) -> Iterator[Layers]:
        """The map of each time, in ascending order: LAYERS (rows, columns)."""
        config, facts, done = ServerConfig(), NO_FACTS, 0
        grid = Grid(CELL_M, FoldConfig())
        for time_ns in times_ns:
            if (newer := self.facts_at(time_ns)) != facts:
                grid, facts, done = Grid(CELL_M, FoldConfig()), newer, 0
            end = int(np.searchsorted(self.time_ns, time_ns, side="right"))
            self._fold(grid, facts, slice(done, end))
            done = end
            yield read_cells(view_of(grid, window, config), window, LAYERS, CELL_M, config)

    def _fold(self, grid: Grid, facts: Facts, part: slice) -> None:
        samples, machine = self.samples[part], self.machine[part]
        trusted = ~np.isin(machine, [i for i, name in enumerate(self.machines) if name in facts.excluded])
        samples, machine = samples[trusted], machine[trusted]
        hashes = np.array([name_hash(name) for name in self.machines], np.uint64)
        grid.fold_all(facts.corrections.applied(samples, self.machines, machine), hashes[machine])


def facts_of(events: Iterable[Mapping[str, Any]]) -> tuple[tuple[int, Facts], ...]:
    """What decisions in a journal came to, and from which site's now on [ns]; none before the first."""
    decisions, out = Decisions(), [(0, NO_FACTS)]
    for event in events:
        decisions.hear([Event(event["id"], event["kind"], event["stamp_ns"], event["body"])], "the journal")
        if decisions.facts.number != out[-1][1].number:
            out.append((event["stamp_ns"], decisions.facts))
    return tuple(out)


def _when(now_ns: Ints, at_ns: Ints, from_ns: int) -> int:
    """When the site's now, which is now_ns (n,) from at_ns (n,) on, was `from_ns`."""
    reached = int(np.searchsorted(now_ns, from_ns))
    return int(at_ns[reached]) if from_ns and reached < len(at_ns) else (0 if not from_ns else int(at_ns[-1]))


# --- one process with a perfect link ---------------------------------------------------------------------------------


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
    return Facts(frozenset(bad), SampleCorrections(own))
