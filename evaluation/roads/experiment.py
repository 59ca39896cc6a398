"""Roads, traffic, losses and repairs, by whole pipelines on recordings whose ground has random patches of soil."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.campaign.experiment import Runner, replay_task
from evaluation.campaign.figures import Goal, Report, Row, judge, rounded
from evaluation.fleet import drives
from evaluation.fleet.drives import Agent, scene
from evaluation.roads.drives import RoadDrive, planned
from evaluation.roads.score import Recorded, repair_figures, road_figures, roads, traffic_figures

REPAIRS_S = 1500.0 / 900.0  # times as long as the other recordings: passes before, and after
DIGITS = 3


@dataclass(frozen=True)
class RoadCase:
    """What a row shows: a scenario, with repairs half-way or without."""

    name: str
    scenario: str
    repairs: bool = False

    def drive(self, seed: int, seconds: float) -> RoadDrive:
        """The recording of a seed."""
        return planned(self.scenario, seed, seconds * (REPAIRS_S if self.repairs else 1.0), repairs=self.repairs)


CASES = (
    RoadCase("haul_road", "haul_road"),
    RoadCase("haul_road_driven", "haul_road_driven"),
    RoadCase("paper_site", "paper_site"),
    RoadCase("repairs", "haul_road", repairs=True),
)
_HAUL, _REPAIRS = {"case": "haul_road"}, {"case": "repairs"}
# Of medians over seeds that nothing was tuned on.
GOALS = (
    Goal(_HAUL, "c_pct", "<=", 8.0),
    Goal(_HAUL, "inside_pct", ">=", 85.0),
    Goal(_HAUL, "driven_pct", ">=", 99.0),
    Goal(_HAUL, "false_pct", "<=", 1.0),
    Goal(_HAUL, "kept_half_pct", ">=", 97.0),
    Goal(_HAUL, "kept_machines_pct", ">=", 97.0),
    Goal(_HAUL, "passes_pct", ">=", 90.0),
    Goal(_HAUL, "direction_pct", ">=", 99.0),
    Goal(_HAUL, "tau", ">=", 0.85),
    Goal(_HAUL, "top_pct", ">=", 97.0),
    Goal(_HAUL, "total_pct", "<=", 8.0),
    Goal(_REPAIRS, "repairs", ">=", 100.0),
    Goal(_REPAIRS, "seen_2_pct", ">=", 80.0),
    Goal(_REPAIRS, "seen_3_pct", ">=", 90.0),
    Goal(_REPAIRS, "looks", ">=", 5000.0),
    Goal(_REPAIRS, "false_per_1000", "<=", 1.0),
    Goal(_REPAIRS, "saved_pct", "<=", 15.0),
)


def run(runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[RoadCase] = CASES) -> tuple[Report, None]:
    """Record, replay, calibrate and judge all cases with all seeds; a row per case, medians or sums over the seeds."""
    wanted = {
        (case, seed, index): replay_task(Agent(index, closed_tours=True), case.drive(seed, seconds))
        for case in cases
        for seed in seeds
        for index in range(case.drive(seed, seconds).machines)
    }
    samples = dict(zip(wanted, runner.run(drives.EXPERIMENT, list(wanted.values())), strict=True))
    table = []
    for case in cases:
        rows = []
        for seed in seeds:
            drive = case.drive(seed, seconds)
            true = scene(drive, runner.cache)
            own = {name: samples[case, seed, index].samples for index, name in enumerate(sorted(true.tracks))}
            rows.append(_judged(case, Recorded.of_drive(drive, own, true, runner.cache)))
        table.append(summarise(case, rows))
    goals = [goal for goal in GOALS if goal.row["case"] in {case.name for case in cases}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": table, "goals": judge(goals, table)}, None


def _judged(case: RoadCase, recorded: Recorded) -> dict[str, float]:
    whole = roads(recorded.rows)
    if case.repairs:
        return repair_figures(recorded, whole)
    return road_figures(recorded, whole) | traffic_figures(recorded, whole)


def summarise(case: RoadCase, rows: Sequence[dict[str, float]]) -> Row:
    """One row; `by_seed` has what each seed gave."""
    figures = {name: [row[name] for row in rows] for name in rows[0]}
    if not case.repairs:
        medians = {name: float(np.median(values)) for name, values in figures.items()}
        return rounded({"case": case.name, **medians, "by_seed": list(rows)}, DIGITS)
    total = {name: sum(values) for name, values in figures.items()}
    return rounded(
        {
            "case": case.name,
            **{name: total[name] for name in ("repairs", "looks", "false_alarms")},
            **{f"seen_{most}_pct": 100.0 * total[f"seen_{most}"] / max(total["repairs"], 1) for most in (2, 3)},
            "false_per_1000": 1000.0 * total["false_alarms"] / max(total["looks"], 1),
            "saved_pct": _percent_off(total["saved_j"], total["true_saved_j"]),
            "by_seed": list(rows),
        },
        DIGITS,
    )


def _percent_off(value: float, true: float) -> float:
    return 100.0 * (value / true - 1) if true else math.nan
