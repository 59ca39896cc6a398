"""Two days on one site: positions of the second day, and the map once its samples lie on those of the first.

The same machines: halves of one recording, with a night between them. Others: the fleet of the next seed comes in the
morning, under names of its own, since each seed draws other errors of sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from lab.campaign.experiment import Experiment, Task
from lab.campaign.recordings import PlannedDrive
from lab.fleet.cases import Rows
from lab.fleet.drives import Scene, scene
from lab.fleet.solving import served
from lab.maps.methods import folded
from lab.paper.maps import Fleet, rmse_m, samples_of
from protocol.arrays import Bools, Floats
from sitegrid.proof.figures import Goal, Row, half_width, rounded
from sitegrid.proof.map_score import region_of, score_driven, true_layers, window_of
from sitegrid.proof.tracks import LoadTrack

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
    """A fleet on its second day. first: what others drove on the first; None: the day before is half of the drive."""

    fleet: Fleet
    first: PlannedDrive | None = None

    @property
    def name(self) -> str:
        """Short and unique."""
        return f"day-after-{self.first.seed}" if self.first else "second-half"


@dataclass(frozen=True)
class Day:
    """Samples by machine, and what is true of their time."""

    rows: Rows
    true: Scene


@dataclass(frozen=True)
class Days:
    """What two days give. net_m: of the smoothed places, day by day. figures: FIGURES (FIRST, ALONE, BOTH).

    FIRST is judged over what was driven on the first day, the others over what was driven on the second.
    """

    net_m: list[float]
    figures: dict[str, dict[str, float]]


def halves(day: Day) -> tuple[Day, Day]:
    """A recording as two days of the same machines."""
    stamps = np.concatenate([rows["stamp_ns"] for rows in day.rows.values()])
    middle_ns = (stamps.min() + stamps.max()) // 2

    def part(*, later: bool) -> Day:
        rows = {name: table[(table["stamp_ns"] >= middle_ns) == later] for name, table in day.rows.items()}
        tracks = {
            name: _of_track(track, (track.stamp_ns >= middle_ns) == later) for name, track in day.true.tracks.items()
        }
        return Day(rows, replace(day.true, tracks=tracks))

    return part(later=False), part(later=True)


def as_others(day: Day) -> Day:
    """The same day of machines with other names."""
    tracks = {_other(name): track for name, track in day.true.tracks.items()}
    return Day({_other(name): rows for name, rows in day.rows.items()}, replace(day.true, tracks=tracks))


def _other(name: str) -> str:
    return f"{name}-other"


def judged_days(first: Day, second: Day) -> Days:
    """Judge two days on the same ground; the second begins at the hour of the first."""
    begins = [min(rows["stamp_ns"][0] for rows in day.rows.values() if len(rows)) for day in (first, second)]
    night_ns = DAY_NS + begins[0] - begins[1]
    both = dict(first.rows)
    for name, rows in second.rows.items():
        later = rows.copy()
        later["stamp_ns"] += night_ns
        both[name] = np.concatenate([both[name], later]) if name in both else later
    maps_of = {FIRST: (first.rows, first.true), ALONE: (second.rows, second.true), BOTH: (both, second.true)}
    return Days(
        [float(np.hypot(*rmse_m(day.rows, day.true))) for day in (first, second)],
        {name: judged(*each) for name, each in maps_of.items()},
    )


def judged(rows: Rows, true: Scene) -> dict[str, float]:
    """FIGURES of the map server's map over the cells that were driven in a scene."""
    region = region_of(true.truth, folded(served(rows).items(), window_of(true.truth), SERVED))
    score = score_driven(region, true_layers(true.truth), [track.place_m for track in true.tracks.values()])
    return {name: float(getattr(score, name)) for name in FIGURES}


def _of_track(track: LoadTrack, where: Bools) -> LoadTrack:
    return LoadTrack(*(getattr(track, field.name)[where] for field in fields(track)))


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
    """Judge two days whose agents have run before."""
    assert task.drive
    second, first = _day(task.drive, task.variant.fleet, cache), task.variant.first
    if first is None:
        return judged_days(*halves(second))
    return judged_days(_day(first, task.variant.fleet, cache), as_others(second))


def _day(drive: PlannedDrive, fleet: Fleet, cache: Path) -> Day:
    true = scene(drive, cache)
    names = sorted(true.tracks)
    return Day({names[agent.index]: samples_of(agent, drive, cache).samples for agent in fleet.agents}, true)


EXPERIMENT = Experiment("days", Days, _solve)
