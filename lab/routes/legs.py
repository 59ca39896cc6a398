"""Drives between stops or around a tour, with routes on map and true map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from lab.calibration.drives import FleetDrive, Scene
from lab.roads.score import Recorded
from lab.routes.maps import KnownMap, true_squares
from mapserver.routes.ground import Squares
from mapserver.routes.route import route
from protocol.arrays import Floats, Ints, Table
from protocol.machine.log_folder import open_log
from protocol.queries.route_requests import RouteQuery
from protocol.queries.routing import MACHINES, RouteMachine, RouteTotals
from protocol.units import GRAVITY_MPS2
from sim.recorder import TRACKS_FOLDER
from sim.scenario.file import load_scenario
from sim.truth import WORK
from sitegrid.proof.figures import root_mean_square
from sitegrid.proof.tracks import LoadTrack

LEAST_M = 100.0  # shorter drives are manoeuvring
STANDING_MPS = 0.05
POINT_M = 1.0  # closer points, near standstill, have no direction
BACK_M, ALIGNED = 3.0, 0.7  # a tour closes within this distance, at this cosine of headings or more


@dataclass(frozen=True)
class Leg:
    """One drive. line_m (k, 2): of the load centre. machine: with the mass stated by samples.

    stops: standing before and after. energy_j: engine work; time_s: duration.
    """

    line_m: Floats
    machine: RouteMachine
    stops: tuple[bool, bool]
    energy_j: float
    time_s: float

    @property
    def length_m(self) -> float:
        """Of the line."""
        return float(np.hypot(*np.diff(self.line_m, axis=0).T).sum())


def legs_of(drive: FleetDrive, scene: Scene, samples: dict[str, Table], cache: Path) -> list[Leg]:
    """All complete forward legs of a recording."""
    legs = []
    for fleet in load_scenario(drive.setup.scenario).fleet:
        for name, track in scene.tracks.items():
            if name.startswith(fleet.name):
                table = np.genfromtxt(
                    drive.folder(cache) / "truth" / TRACKS_FOLDER / f"{name}.csv", delimiter=",", names=True
                )
                kind = replace(MACHINES["truck" if "truck" in name else "loader"], speed_mps=fleet.drive_mps)
                described_kg = open_log(drive.folder(cache) / "logs" / name).machine.mass_kg
                for begin, end, stops in _spans(table, track):
                    mass_kg = _stated_kg(samples[name], track.stamp_ns[[begin, end]], described_kg)
                    legs.append(_leg(table, track, begin, end, replace(kind, mass_kg=mass_kg), stops))
    return legs


def _leg(table: Table, track: LoadTrack, begin: int, end: int, machine: RouteMachine, stops: tuple[bool, bool]) -> Leg:
    own = slice(begin, end + 1)
    driven_m = track.driven_m[own]
    at_m = np.linspace(driven_m[0], driven_m[-1], 1 + round((driven_m[-1] - driven_m[0]) / POINT_M))
    line = np.stack([np.interp(at_m, driven_m, axis) for axis in track.place_m[own].T], axis=1)
    energy_j = float(table[WORK][end] - table[WORK][begin])
    return Leg(line, machine, stops, energy_j, float(track.stamp_ns[end] - track.stamp_ns[begin]) * 1e-9)


def _spans(table: Table, track: LoadTrack) -> Iterator[tuple[int, int, tuple[bool, bool]]]:
    """First and last instant of each leg, and standstill there."""
    speed = table["speed"]
    moves = np.abs(speed) > STANDING_MPS
    edges = np.flatnonzero(np.diff(moves.astype(int))) + 1
    bounds = [0, *edges.tolist(), len(moves)]
    for begin, end in pairwise(bounds):
        if not moves[begin] or (speed[begin:end] < -STANDING_MPS).any():
            continue
        if begin > 0 and end < len(moves):
            if track.driven_m[end] - track.driven_m[begin - 1] >= LEAST_M:
                yield begin - 1, end, (True, True)
        else:
            yield from ((lap, then, (False, False)) for lap, then in _laps(track, begin, end))


def _laps(track: LoadTrack, begin: int, end: int) -> Iterator[tuple[int, int]]:
    """Complete laps of a closed loop, starting at full speed."""
    first = int(np.searchsorted(track.driven_m, track.driven_m[begin] + LEAST_M))
    while first < end:
        on = np.arange(first, end)
        far = on[track.driven_m[on] - track.driven_m[first] > LEAST_M]
        off_m = np.hypot(*(track.place_m[far] - track.place_m[first]).T)
        near = far[(off_m < BACK_M) & (np.cos(track.yaw_rad[far] - track.yaw_rad[first]) > ALIGNED)]
        if not near.size:
            return
        again = near[: 1 + int(np.argmax(np.diff(near, append=end + 2) > 1))]  # first return
        last = int(again[np.hypot(*(track.place_m[again] - track.place_m[first]).T).argmin()])
        yield first, last
        first = last


def _stated_kg(samples: Table, span_ns: Ints, described_kg: float) -> float:
    """Median mass of a span's samples, else the described one."""
    own = samples["mass_kg"][(samples["stamp_ns"] >= span_ns[0]) & (samples["stamp_ns"] <= span_ns[1])]
    known = own[np.isfinite(own)]
    return float(np.median(known)) if known.size else described_kg


# --- routes of legs ---------------------------------------------------------------------------------------------------


Judged = dict[str, float]
# Legs of one drive: tolerance of length and mass, distance along the lines, places compared.
ALIKE, ALIKE_M, PLACES = 0.05, 10.0, 9


def judged_legs(drive: FleetDrive, recorded: Recorded, scene: Scene, cache: Path) -> list[Judged]:
    """Each leg's relative route errors, and whether the interval holds the truth."""
    known, truth = KnownMap(recorded.rows), true_squares(scene.truth)
    routes = known.routes()

    def asked(leg: Leg, line: Floats) -> RouteTotals:
        places = tuple(map(tuple, line.tolist()))
        return routes.route(RouteQuery(places, machine=leg.machine, stops=leg.stops)).totals

    legs = legs_of(drive, scene, dict(recorded.rows), cache)
    return [
        {**_judged(leg, asked(leg, leg.line_m), asked(leg, leg.line_m[::-1]), truth), "drive": float(number)}
        for leg, number in zip(legs, drives_of(legs), strict=True)
    ]


def drives_of(legs: Sequence[Leg]) -> list[int]:
    """Drive repeated by each leg: one line with one load has common errors, however often driven."""
    numbers: list[int] = []
    for i, leg in enumerate(legs):
        same = (numbers[k] for k in range(i) if _alike(leg, legs[k]))
        numbers.append(next(same, max(numbers, default=-1) + 1))
    return numbers


def _alike(a: Leg, b: Leg) -> bool:
    if abs(a.length_m - b.length_m) > ALIKE * a.length_m or abs(a.machine.mass_kg - b.machine.mass_kg) > (
        ALIKE * a.machine.mass_kg
    ):
        return False
    shares = np.linspace(0, 1, PLACES)
    first, second = (leg.line_m[np.round(shares * (len(leg.line_m) - 1)).astype(int)] for leg in (a, b))
    return bool(np.hypot(*(first - second).T).max() < ALIKE_M)


def _judged(leg: Leg, there: RouteTotals, back: RouteTotals, truth: Squares) -> Judged:
    """back: never driven; its truth is the drive over the true map."""
    _, true_there = route(leg.line_m, truth, leg.machine, stops=leg.stops)
    _, true_back = route(leg.line_m[::-1], truth, leg.machine, stops=leg.stops)
    steady_j = leg.machine.mass_kg * GRAVITY_MPS2 * (_rolling(leg, truth) + true_there.lift_m)
    return {
        "length_m": leg.length_m,
        "energy": there.energy_j / leg.energy_j - 1,
        "time": there.time_s / leg.time_s - 1,
        "model": true_there.energy_j / leg.energy_j - 1,
        "steady": steady_j / leg.energy_j - 1,
        "map": there.energy_j / true_there.energy_j - 1,
        "back": back.energy_j / true_back.energy_j - 1,
        "energy_inside": float(there.energy_low_j <= leg.energy_j <= there.energy_high_j),
        "time_inside": float(there.time_low_s <= leg.time_s <= there.time_high_s),
        "back_inside": float(back.energy_low_j <= true_back.energy_j <= back.energy_high_j),
        "width": (there.energy_high_j - there.energy_low_j) / there.energy_j,
    }


def _rolling(leg: Leg, truth: Squares) -> float:
    """Resistance times distance [m], without starts, stops, climbs."""
    middles = 0.5 * (leg.line_m[1:] + leg.line_m[:-1])
    return float((truth.at(middles)["resistance_filled"] * np.hypot(*np.diff(leg.line_m, axis=0).T)).sum())


def seed_figures(legs: Sequence[Judged]) -> dict[str, float]:
    """Percent over a recording's legs: RMS, means, worst, shares inside intervals."""
    column = {name: np.array([leg[name] for leg in legs]) for name in legs[0]}
    holds = [column["energy_inside"][column["drive"] == number].mean() for number in np.unique(column["drive"])]
    return {
        "legs": len(legs),
        "drives": len(holds),
        "km": float(column["length_m"].sum() / 1000),
        **{
            f"{name}_pct": 100.0 * root_mean_square(column[name]) for name in ("energy", "back", "time", "model", "map")
        },
        "energy_mean_pct": 100.0 * float(column["energy"].mean()),
        "energy_worst_pct": 100.0 * float(np.abs(column["energy"]).max()),
        "time_mean_pct": 100.0 * float(column["time"].mean()),
        "model_mean_pct": 100.0 * float(column["model"].mean()),
        "steady_mean_pct": 100.0 * float(column["steady"].mean()),
        **{f"{name}_inside_pct": 100.0 * float(column[f"{name}_inside"].mean()) for name in ("energy", "back", "time")},
        "drives_inside_pct": 100.0 * float(np.mean(holds)),
        "width_pct": 100.0 * float(column["width"].mean()),
    }
