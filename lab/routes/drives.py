"""Routes of complete legs: by the map, by the true map, and as the simulator's machines drove them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lab.calibration.drives import FleetDrive, Scene
from lab.roads.score import Recorded
from lab.routes.legs import Leg, legs_of
from lab.routes.maps import KnownMap, true_squares
from mapserver.routes.ground import Squares
from mapserver.routes.route import route
from protocol.arrays import Floats
from protocol.queries.route_requests import RouteQuery
from protocol.queries.routing import RouteTotals
from protocol.units import GRAVITY_MPS2
from sitegrid.proof.figures import root_mean_square

Judged = dict[str, float]
# Legs that are one drive: length and mass within this share, and places along the lines within this distance.
ALIKE, ALIKE_M, PLACES = 0.05, 10.0, 9


def judged_legs(drive: FleetDrive, recorded: Recorded, scene: Scene, cache: Path) -> list[Judged]:
    """Figures of every leg: shares that the route is off, and whether its interval holds the truth."""
    known, truth = KnownMap(recorded.rows), true_squares(scene.truth)
    routes = known.routes()

    def asked(leg: Leg, line: Floats) -> RouteTotals:
        places = tuple(map(tuple, line.tolist()))
        return routes.route(RouteQuery(places, leg.machine, leg.stops)).totals

    legs = legs_of(drive, scene, dict(recorded.rows), cache)
    return [
        {**_judged(leg, asked(leg, leg.line_m), asked(leg, leg.line_m[::-1]), truth), "drive": float(number)}
        for leg, number in zip(legs, drives_of(legs), strict=True)
    ]


def drives_of(legs: Sequence[Leg]) -> list[int]:
    """Which drive each leg repeats: one line with one load has its errors in common, however often it is driven."""
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
    """back: nobody drove it; its truth is the same drive over the true map."""
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
    """Resistance times way [m]: what a drive costs that neither starts nor brakes, and rises nowhere."""
    middles = 0.5 * (leg.line_m[1:] + leg.line_m[:-1])
    return float((truth.at(middles)["resistance_filled"] * np.hypot(*np.diff(leg.line_m, axis=0).T)).sum())


def seed_figures(legs: Sequence[Judged]) -> dict[str, float]:
    """Of one recording, in percent: root mean square over its legs, means, the worst leg, and shares inside."""
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
