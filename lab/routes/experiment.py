"""Routes and ways judged: whole pipelines on random soil patches; drawn maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lab.calibration import drives as fleets
from lab.calibration.drives import Agent, scene
from lab.campaign.experiment import Runner, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import column, median, summary
from lab.roads.drives import RoadDrive, planned
from lab.roads.score import Recorded
from lab.routes import ways
from lab.routes.legs import judged_legs, seed_figures
from sitegrid.proof.figures import Report, Row, rounded

LONGER = 4.0 / 3.0  # relative recording length: the check on driving style
DIGITS = 2


@dataclass(frozen=True)
class RouteCase:
    """A scenario. longer: relative recording length; 0: ways on drawn maps."""

    name: str
    longer: float = 1.0

    def drive(self, seed: int, seconds: float) -> RoadDrive:
        """A seed's recording, shared with `python -m lab roads` at equal length."""
        return planned(self.name, seed, seconds * self.longer)


CASES = (
    RouteCase("haul_road"),
    RouteCase("paper_site"),
    RouteCase("paper_site_driven", LONGER),
    RouteCase("ways", 0.0),
)
WORST = ("energy_pct", "back_pct", "time_pct")  # the worst seed is judged too


def run(
    runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[RouteCase] = CASES
) -> tuple[Report, None]:
    """Record, replay, calibrate, judge; a row per case. Ways use maps drawn from the first seed."""
    wanted = [case for case in cases if case.longer]
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
        rows.append(row_of(case.name, by_seed))
    on_maps = rounded(ways.rows(seeds[0]), DIGITS) if len(wanted) < len(cases) else []
    table = [*rows, *on_maps]
    known = [goal for goal in goals("routes") if goal.row["case"] in {row["case"] for row in table}]
    return {"seeds": list(seeds), "seconds": seconds, "rows": rows, "ways": on_maps, "goals": judge(known, table)}, None


def row_of(name: str, by_seed: Sequence[Row]) -> Row:
    """Medians over seeds, sums of drives, and `max_...` of the worst seed."""
    sums = {key: float(sum(column(by_seed, key))) for key in ("legs", "drives", "km")}
    worst = {f"max_{key}": max(column(by_seed, key)) for key in WORST}
    return rounded(summary({"case": name}, by_seed, median, **sums, **worst), DIGITS)
