"""Routes and ways judged: by whole pipelines on recordings whose ground has random patches, and on drawn maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.campaign.experiment import Runner, replay_task
from lab.fleet import drives as fleets
from lab.fleet.drives import Agent, scene
from lab.roads.drives import RoadDrive, planned
from lab.roads.score import Recorded
from lab.routes import ways
from lab.routes.drives import judged_legs, seed_figures
from protocol.errors import ConfigError
from sitegrid.proof.figures import Goal, Report, Row, judge, rounded

LONGER = 4.0 / 3.0  # times as long as the others: the check on how people drive
DIGITS = 2
WAYS = "ways"


@dataclass(frozen=True)
class RouteCase:
    """What a row shows: a scenario. longer: as many times as long as the others."""

    name: str
    longer: float = 1.0

    def drive(self, seed: int, seconds: float) -> RoadDrive:
        """The recording of a seed: that of `sitegrid eval roads`, where it has the same length."""
        return planned(self.name, seed, seconds * self.longer)


CASES = (RouteCase("haul_road"), RouteCase("paper_site"), RouteCase("paper_site_driven", LONGER))
NAMES = (*(case.name for case in CASES), WAYS)
# Of medians over seeds that nothing was tuned on, and of the worst of them.
LIMITS = {"energy_pct": (5.0, 7.0), "back_pct": (5.0, 7.0), "time_pct": (3.0, 5.0)}
GOALS = (
    *(
        Goal({"case": case.name}, name if limit is limits[0] else f"max_{name}", "<=", limit)
        for case in CASES
        for name, limits in LIMITS.items()
        for limit in limits
    ),
    *(
        Goal({"case": f"way_{case}"}, figure, "<=", limit)
        for case in ("random", "even", "sand")
        for figure, limit in (("over_median_pct", 1.0), ("over_worst_pct", 2.0))
    ),
    Goal({"case": "way_unknown"}, "not_over", ">=", ways.MAPS["unknown"]),
)


def run(runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[str] = NAMES) -> tuple[Report, None]:
    """Record, replay, calibrate and judge; a row per case. Ways are asked on maps drawn from the first seed."""
    wanted = [case for case in CASES if case.name in cases]
    tasks = {
        (case, seed, index): replay_task(Agent(index, closed_tours=True), case.drive(seed, seconds))
        for case in wanted
        for seed in seeds
        for index in range(case.drive(seed, seconds).machines)
    }
    samples = dict(zip(tasks, runner.run(fleets.EXPERIMENT, list(tasks.values())), strict=True))
    rows = []
    for case in wanted:
        by_seed = []
        for seed in seeds:
            drive = case.drive(seed, seconds)
            true = scene(drive, runner.cache)
            own = {name: samples[case, seed, index].samples for index, name in enumerate(sorted(true.tracks))}
            recorded = Recorded.of_drive(drive, own, true, runner.cache)
            by_seed.append(seed_figures(judged_legs(drive, recorded, true, runner.cache)))
        rows.append(summarise(case.name, by_seed))
    on_maps = rounded(ways.rows(seeds[0]), DIGITS) if WAYS in cases else []
    table = [*rows, *on_maps]
    goals = [goal for goal in GOALS if goal.row["case"] in {row["case"] for row in table}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": rows, "ways": on_maps, "goals": judge(goals, table)}, None


def summarise(name: str, rows: Sequence[dict[str, float]]) -> Row:
    """One row: sums, medians over the seeds, and `max_...`, of the worst seed; `by_seed` has what each seed gave."""
    figures = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    sums = {key: float(figures.pop(key).sum()) for key in ("legs", "drives", "km")}
    medians = {key: float(np.median(values)) for key, values in figures.items()}
    worst = {f"max_{key}": float(figures[key].max()) for key in LIMITS}
    return rounded({"case": name, **sums, **medians, **worst, "by_seed": list(rows)}, DIGITS)


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Check names of cases; none means all."""
    if unknown := [name for name in names if name not in NAMES]:
        raise ConfigError("--cases", f"{unknown[0]!r} is not known; known: {', '.join(NAMES)}")
    return tuple(names) or NAMES
