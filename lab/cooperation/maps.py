"""Maps of one arm at any time, from its journal or from one process with a perfect link.

Decisions count from when they were made, so an early map shows what the server knew then. (A map server asked for the
past corrects with today's knowledge; that is `decided`.)
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
LAG_NS = round(LocalisationConfig().lag_s * 1e9)  # the smoother's: samples are final then


@dataclass(frozen=True)
class Timeline:
    """Samples (n,) in order of time_ns (n,); machine (n,): index in `machines`.

    facts: decisions with their start, the first from the beginning.
    """

    samples: Table
    machine: Ints
    machines: tuple[str, ...]
    time_ns: Ints
    facts: tuple[tuple[int, Facts], ...]

    @classmethod
    def of_run(cls, run: LiveRun, *, arrived: bool = False, decided: bool = False) -> Timeline:
        """From an arm's run. arrived: by arrival, not stamp. decided: all decisions count from the beginning."""
        stamps = run.samples["stamp_ns"].astype(np.int64)
        time_ns = run.arrived_ns if arrived else stamps
        order = np.argsort(time_ns, kind="stable")
        facts = facts_of(run.events)
        if decided:
            facts = ((0, facts[-1][1]),)
        elif arrived:  # the site's now is the newest arrived stamp
            now_ns, at_ns = np.maximum.accumulate(stamps[order]), time_ns[order]
            facts = tuple((_when(now_ns, at_ns, from_ns), each) for from_ns, each in facts)
        return cls(run.samples[order], run.machine[order], tuple(run.machines), time_ns[order], facts)

    def of_machines(self, names: Iterable[str]) -> Timeline:
        """Samples of some machines only."""
        numbers = [self.machines.index(name) for name in names]
        chosen = np.isin(self.machine, numbers)
        return Timeline(self.samples[chosen], self.machine[chosen], self.machines, self.time_ns[chosen], self.facts)

    def by_machine(self, names: Iterable[str]) -> dict[str, Table]:
        """Samples by machine."""
        return {name: self.samples[self.machine == self.machines.index(name)] for name in names}

    def facts_at(self, time_ns: int) -> Facts:
        """Decisions up to a time."""
        return [each for from_ns, each in self.facts if from_ns <= time_ns][-1]

    def maps(self, times_ns: Iterable[int], window: CellWindow) -> Iterator[Layers]:
        """LAYERS (rows, columns) at each time, ascending."""
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
    """Facts from a journal's decisions, each with its site's now [ns]; none before the first."""
    decisions, out = Decisions(), [(0, NO_FACTS)]
    for event in events:
        decisions.hear([Event(event["id"], event["kind"], event["stamp_ns"], event["body"])], "the journal")
        if decisions.facts.number != out[-1][1].number:
            out.append((event["stamp_ns"], decisions.facts))
    return tuple(out)


def _when(now_ns: Ints, at_ns: Ints, from_ns: int) -> int:
    """Time at which the site's now, now_ns (n,) from at_ns (n,), reached `from_ns`."""
    reached = int(np.searchsorted(now_ns, from_ns))
    return int(at_ns[reached]) if from_ns and reached < len(at_ns) else (0 if not from_ns else int(at_ns[-1]))


# --- one process with a perfect link ---------------------------------------------------------------------------------


def central_tasks(arm: Arm, seed: int) -> list[Task[Agent]]:
    """Pipelines of an arm's machines with agents' defaults."""
    drive = arm.drive(seed)
    order = sorted(drive.machines)  # order of log folders
    return [replay_task(Agent(order.index(name), closed_tours=True), drive) for name in arm.names(drive)]


def central_timeline(arm: Arm, seed: int, cache: Path, *, arrived: bool) -> Timeline:
    """Timeline of such a process, by stamp or finality; it judges and calibrates once a minute."""
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
    """The server's trust and calibration on samples."""
    if not rows:
        return NO_FACTS
    bad = accused(rows, calibrated(rows))
    result = calibrated(rows, bad)
    own = [each for name in rows if name not in bad for each in of_machine(result, name)]
    return Facts(frozenset(bad), SampleCorrections(own))
