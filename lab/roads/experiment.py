"""Roads, traffic, losses and repairs from whole pipelines on random soil patches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from lab.calibration import drives
from lab.calibration.drives import Agent, AgentSamples, scene
from lab.campaign.experiment import Experiment, Runner, Task, read_result, replay_task
from lab.campaign.figures import judge
from lab.campaign.goals import goals
from lab.campaign.summary import column, median, summary
from lab.roads.changes import ChangedGround, Changes, changes, pooled
from lab.roads.drives import RoadDrive, planned
from lab.roads.repairs import SegmentRepairs, repair_figures
from lab.roads.score import Recorded, kept_after, road_figures, roads, traffic_figures
from sitegrid.proof.figures import Report, Row, rounded

REPAIRS_S = 1500.0 / 900.0  # recording length relative to others: passes before and after
DIGITS = 3
CELLS_SHOWN = ("changed", "since")  # read options that show cells of repaired segments


@dataclass(frozen=True)
class RoadCase:
    """A row: a scenario, with repairs at half time or without."""

    name: str
    scenario: str
    repairs: bool = False

    def drive(self, seed: int, seconds: float) -> RoadDrive:
        """Recording of a seed."""
        return planned(self.scenario, seed, seconds * (REPAIRS_S if self.repairs else 1.0), repairs=self.repairs)


CASES = (
    RoadCase("haul_road", "haul_road"),
    RoadCase("haul_road_driven", "haul_road_driven"),
    RoadCase("paper_site", "paper_site"),
    RoadCase("repairs", "haul_road", repairs=True),
)


@dataclass(frozen=True)
class Judging:
    """A recording to judge. seconds: of the case. other: seed of another day on the same roads."""

    case: RoadCase
    seconds: float
    other: int | None

    @property
    def name(self) -> str:
        """Short unique name."""
        return self.case.name


@dataclass(frozen=True)
class Judged:
    """Figures of one recording by name. changes: `Changes` as plain values, with repairs only."""

    figures: dict[str, float]
    changes: list[Row] = field(default_factory=list)


def run(runner: Runner, seeds: Sequence[int], seconds: float, cases: Sequence[RoadCase] = CASES) -> tuple[Report, None]:
    """Record, replay, calibrate and judge all cases and seeds; a row per case, medians or sums.

    Case by case with each seed judged at once, so that interrupted runs resume with whole rows.
    """
    table, detected = [], []
    for case in cases:
        runner.run(drives.EXPERIMENT, [task for seed in seeds for task in agent_tasks(case.drive(seed, seconds))])
        others = [*seeds[1:], seeds[0]] if len(seeds) > 1 else [None]
        tasks = [
            replay_task(Judging(case, seconds, None if case.repairs else other), case.drive(seed, seconds))
            for seed, other in zip(seeds, others, strict=True)
        ]
        judged = runner.run(EXPERIMENT, tasks)
        table.append(row_of(case, [each.figures for each in judged]))
        detected += change_rows([each.changes for each in judged])
    known = [goal for goal in goals("roads") if goal.row["case"] in {case.name for case in cases}]
    report = {"seeds": list(seeds), "seconds": seconds, "rows": table, "changes": detected}
    return report | {"goals": judge(known, table)}, None


def agent_tasks(drive: RoadDrive) -> list[Task[Agent]]:
    """Replays of all machines of a recording."""
    return [replay_task(drive.agent(index), drive) for index in range(drive.machines)]


def _recorded(drive: RoadDrive, cache: Path) -> Recorded:
    true, rows = scene(drive, cache), {}
    for name, task in zip(sorted(true.tracks), agent_tasks(drive), strict=True):
        rows[name] = read_result(AgentSamples, drives.EXPERIMENT.file(task, cache)).samples
    return Recorded.of_drive(drive, rows, true, cache)


def _solve(task: Task[Judging], cache: Path) -> Judged:
    what = task.variant
    drive = what.case.drive(task.seed, what.seconds)
    recorded = _recorded(drive, cache)
    whole = roads(recorded.rows)
    if what.case.repairs:
        seen = SegmentRepairs.of_recording(recorded, whole)
        ground = ChangedGround.of_drive(drive, scene(drive, cache), cache)
        detected = changes(recorded, whole, seen, ground)
        return Judged(repair_figures(recorded, whole, seen), [asdict(each) for each in detected])
    figures = road_figures(recorded, whole) | traffic_figures(recorded, whole)
    if what.other is None:
        return Judged(figures | {"kept_day_pct": math.nan})
    later = _recorded(what.case.drive(what.other, what.seconds), cache)
    return Judged(figures | {"kept_day_pct": kept_after(recorded, later, whole)})


EXPERIMENT = Experiment("roads", Judged, _solve)


def row_of(case: RoadCase, by_seed: Sequence[Row]) -> Row:
    """Medians over seeds; for repairs sums and their ratios."""
    if not case.repairs:
        return rounded(summary({"case": case.name}, by_seed, median), DIGITS)
    total = {name: sum(column(by_seed, name)) for name in by_seed[0]}
    figures = {
        **{name: total[name] for name in ("repairs", "looks", "false_alarms")},
        **{f"seen_{most}_pct": 100.0 * total[f"seen_{most}"] / max(total["repairs"], 1) for most in (2, 3)},
        "false_per_1000": 1000.0 * total["false_alarms"] / max(total["looks"], 1),
        "saved_pct": 100.0 * (total["saved_j"] / total["true_saved_j"] - 1) if total["true_saved_j"] else math.nan,
        **{f"cells_{name}_pct": 100.0 * total[f"cells_{name}"] / max(total["cells"], 1) for name in CELLS_SHOWN},
    }
    return rounded({"case": case.name, **figures, "by_seed": list(by_seed)}, DIGITS)


def change_rows(by_seed: Sequence[Sequence[Row]]) -> list[Row]:
    """A row per kind of place over all seeds; none without repairs."""
    kinds = zip(*([Changes(**row) for row in own] for own in by_seed), strict=True)
    return [rounded(pooled(of_kind), DIGITS, km2_days=8) for of_kind in kinds]
