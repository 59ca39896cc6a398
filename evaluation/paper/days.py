"""Two days on one site: positions of the second day, and the map once its samples lie on those of the first.

The drives of two seeds on the same ground are one day after the other. Agents start anew on the second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation.campaign.experiment import Experiment, Task
from evaluation.campaign.figures import Goal, Row, half_width, rounded
from evaluation.campaign.recordings import PlannedDrive
from evaluation.fleet.cases import Rows
from evaluation.fleet.drives import Scene, scene
from evaluation.fleet.solving import served
from evaluation.maps.methods import folded
from evaluation.maps.score import region_of, score_driven, true_layers, window_of
from evaluation.paper import maps
from evaluation.paper.maps import Fleet, rmse_m, samples_of
from protocol.arrays import Floats, Table

DAY_NS = 86_400 * 10**9
FIGURES = ("wrong_resistance_pct", "wrong_grade_pct", "known_pct")
SERVED = ("resistance", "grade_east", "grade_north")
FIRST, ALONE, BOTH = "first day", "second day alone", "both days"
DIGITS = 4
# The map of both days against that of the second alone, over what was driven on the second.
WORSE = {name: f"worse_{name}" for name in FIGURES}  # by so many points
SIGNS = {"wrong_resistance_pct": 1.0, "wrong_grade_pct": 1.0, "known_pct": -1.0}
GOALS = tuple(Goal({"samples": BOTH}, figure, "<=", 0.1) for figure in WORSE.values())


@dataclass(frozen=True)
class SecondDay:
    """A fleet on the day after another drive of it, which is the first day."""

    fleet: Fleet
    first: PlannedDrive

    @property
    def name(self) -> str:
        """Short and unique."""
        return f"day-after-{self.first.seed}"


@dataclass(frozen=True)
class Days:
    """What two days give. net_m: of the smoothed places, day by day. figures: FIGURES (FIRST, ALONE, BOTH).

    FIRST is judged over what was driven on the first day, the others over what was driven on the second.
    """

    net_m: list[float]
    figures: dict[str, dict[str, float]]


def second_day(first: tuple[Rows, Scene], second: tuple[Rows, Scene]) -> Days:
    """Judge two days on the same ground: samples and truth of each."""
    (rows, true), (later, later_true) = first, second
    both = {name: np.concatenate([rows[name], _moved(later[name], rows[name])]) for name in later}
    figures = {
        FIRST: judged(rows, true),
        ALONE: judged(later, later_true),
        BOTH: judged(both, later_true),
    }
    return Days([float(np.hypot(*rmse_m(*each))) for each in (first, second)], figures)


def judged(rows: Rows, true: Scene) -> dict[str, float]:
    """FIGURES of the map server's map over the cells that were driven in a scene."""
    region = region_of(true.truth, folded(served(rows).items(), window_of(true.truth), SERVED))
    score = score_driven(region, true_layers(true.truth), [track.place_m for track in true.tracks.values()])
    return {name: float(getattr(score, name)) for name in FIGURES}


def _moved(rows: Table, after: Table) -> Table:
    """Samples as if they were of the day after others, from the same hour on."""
    rows = rows.copy()
    rows["stamp_ns"] += DAY_NS + after["stamp_ns"][0] - rows["stamp_ns"][0]
    return rows


# --- rows ------------------------------------------------------------------------------------------------------------


def day_rows(named: Row, seeds: Sequence[Days]) -> list[Row]:
    """A row per set of samples: means over the pairs of seeds.

    `worse_...`, of both days: by how many points they are worse than the second alone, 0 where they are not.
    """
    net_m = np.array([days.net_m for days in seeds])
    places = {FIRST: net_m[:, 0], ALONE: net_m[:, 1], BOTH: net_m[:, 1]}
    return [rounded({**named, "samples": name, **_means(name, seeds, places[name])}, DIGITS) for name in places]


def _means(name: str, seeds: Sequence[Days], net_m: Floats) -> Row:
    own, alone = (_columns([days.figures[each] for days in seeds]) for each in (name, ALONE))
    parts = {"net_m": net_m, **own}
    worse = {WORSE[figure]: SIGNS[figure] * float((own[figure] - alone[figure]).mean()) for figure in FIGURES}
    return {
        **{figure: float(values.mean()) for figure, values in parts.items()},
        **{figure: max(0.0, value) if name == BOTH else None for figure, value in worse.items()},
        "ci95": {figure: half_width(values) for figure, values in parts.items()},
    }


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, Floats]:
    return {name: np.array([row[name] for row in rows]) for name in FIGURES}


# --- in the worker processes -----------------------------------------------------------------------------------------


def _solve(task: Task[SecondDay], cache: Path) -> Days:
    """Judge a pair of drives whose agents have run before."""
    assert task.drive
    days = []
    for drive in (task.variant.first, task.drive):
        true = scene(drive, cache)
        names = sorted(true.tracks)
        agents = task.variant.fleet.agents
        days.append(({names[each.index]: samples_of(each, drive, cache).samples for each in agents}, true))
    return second_day(*days)


EXPERIMENT = Experiment("days", Days, (*maps.SOURCES, "evaluation/paper/days.py", "evaluation/maps/score.py"), _solve)
