"""Segments, worklist and litres by torque from a bus, with what may be wrong there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.calibration import drives
from lab.calibration.drives import AgentSamples, scene
from lab.campaign.experiment import Experiment, Runner, Task, read_result, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import median, summary
from lab.can.drives import BusDrive, planned
from lab.roads.experiment import DIGITS, agent_tasks
from lab.roads.score import TARGET, Recorded, judged_segments, roads, tally_of, traffic_figures, true_traffic
from mapserver.roads.fuel import litres_of
from mapserver.roads.ledger import Ledgers
from mapserver.roads.loss import losses
from mapserver.roads.segments import SegmentTable
from sitegrid.proof.figures import Report, Row, rounded

NEAR = 0.1  # of what is burned: predicted litres within it are right
LEAST_SHARE = 0.5  # of the driving with fuel, for a segment's litres to be judged


@dataclass(frozen=True)
class BusCase:
    """What a row shows; see `BusDrive`. preset: in place of the scenario's."""

    name: str
    scenario: str
    can: bool = True
    reference: float = 1.0
    blind: bool = False
    preset: str = ""

    def drive(self, seed: int, seconds: float) -> BusDrive:
        """The recording of a seed."""
        how = {"can": self.can, "blind": self.blind}
        return planned(self.scenario, seed, seconds, reference=self.reference, preset=self.preset, **how)


CASES = (
    BusCase("trucks_wheels", "haul_road", can=False),
    BusCase("trucks_switch", "haul_road", can=False, preset="brake_switch"),
    BusCase("trucks_bus", "haul_road"),
    BusCase("trucks_reference", "haul_road", reference=1.1),
    BusCase("loaders_wheels", "loading", can=False),
    BusCase("loaders_bus", "loading"),
    BusCase("loaders_blind", "loading", blind=True),
)


@dataclass(frozen=True)
class Judging:
    """One recording of a case to be judged."""

    case: BusCase
    seconds: float

    @property
    def name(self) -> str:
        """Short and unique."""
        return self.case.name


@dataclass(frozen=True)
class Judged:
    """Figures of one recording, by name."""

    figures: dict[str, float]


def run(runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[BusCase] = CASES) -> tuple[Report, None]:
    """Record, replay, calibrate and judge all cases with all seeds; a row per case, medians over the seeds."""
    table = []
    for case in cases:
        own = [case.drive(seed, seconds) for seed in seeds]
        runner.run(drives.EXPERIMENT, [task for drive in own for task in agent_tasks(drive)])
        judged = runner.run(EXPERIMENT, [replay_task(Judging(case, seconds), drive) for drive in own])
        table.append(rounded(summary({"case": case.name}, [one.figures for one in judged], median), DIGITS))
    _compare(table)
    known = [goal for goal in goals("can") if goal.row["case"] in {case.name for case in cases}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": table, "goals": judge(known, table)}, None


def _compare(table: list[Row]) -> None:
    """Errors over those by torque at the wheels, of the same machines."""
    wheels = {row["case"].split("_")[0]: row["c_pct"] for row in table if row["case"].endswith("_wheels")}
    for row in table:
        known = wheels.get(row["case"].split("_")[0], math.nan)
        row["times"] = round(row["c_pct"] / known, DIGITS)


def _solve(task: Task[Judging], cache: Path) -> Judged:
    """Judge one recording."""
    what = task.variant
    drive = what.case.drive(task.seed, what.seconds)
    true, rows = scene(drive, cache), {}
    for name, agent in zip(sorted(true.tracks), agent_tasks(drive), strict=True):
        rows[name] = read_result(AgentSamples, drives.EXPERIMENT.file(agent, cache)).samples
    recorded = Recorded.of_drive(drive, rows, true, cache)
    whole = roads(recorded.rows)
    raw = Recorded.of_drive(drive, rows, true, cache, calibrates=False)
    alone = traffic_figures(raw, whole)["c_pct"]
    figures = traffic_figures(recorded, whole) | {"c_uncalibrated_pct": alone}
    return Judged(figures | fuel_figures(recorded, whole))


def fuel_figures(recorded: Recorded, whole: SegmentTable) -> dict[str, float]:
    """Predicted litres of segments against burned ones, and resistance's share of the samples."""
    ledgers, tally = Ledgers(whole), tally_of(recorded.rows)
    ledger = ledgers.ledger(tally.table(), tally.slot_ns)
    valued = np.concatenate([np.isfinite(table["c_rr"]) for table in recorded.rows.values()])
    out = {"valued_pct": 100.0 * float(valued.mean())}
    fuel = litres_of(ledger, whole, losses(ledger, whole, TARGET))
    if fuel is None:
        return out | dict.fromkeys(("litres_near_pct", "litres_rms_pct", "litres_known_pct"), float("nan"))
    judged = judged_segments(true_traffic(recorded.tracks.values(), ledgers, TARGET), whole)
    known = judged & (fuel.share > LEAST_SHARE) & (fuel.burned > 0)
    off = fuel.predicted[known] / fuel.burned[known] - 1
    return out | {
        "litres_near_pct": 100.0 * float((np.abs(off) <= NEAR).mean()),
        "litres_rms_pct": 100.0 * float(np.sqrt(np.mean(off**2))),
        "litres_known_pct": 100.0 * float(known.sum() / judged.sum()),
    }


EXPERIMENT = Experiment("can", Judged, _solve)
