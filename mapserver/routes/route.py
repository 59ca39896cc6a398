"""A route: the ground along a line, and the cost of a machine's drive with 90 % intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from mapserver.error_model import ALIKE_M, GAP_SHARE, NINETY, UNKNOWN_SHARE, UNKNOWN_SLOPE_STD, line_variance
from mapserver.routes.drive import Drive, drive, smoothed
from mapserver.routes.ground import Squares, Steps, limits, squares_at, steps
from mapserver.routes.prices import EAST, NORTH, RESISTANCE, Prices
from protocol.arrays import Bools, Floats
from protocol.errors import QueryError, Refusal
from protocol.queries.routing import RouteMachine, RouteSteps, RouteTotals

# Layers that a route reads: gaps between known cells are filled; beyond, ground is unknown.
LAYERS = (
    "resistance_filled",
    "grade_east_filled",
    "grade_north_filled",
    "resistance_filled_std",
    "grade_filled_std",
    "visits",
    "confidence",
)
STEP_M = 1.0  # step of the drive [m]; answers have longer ones
# Relative spread of drives on equal ground (drivers, crossing traffic), from three simulated recordings: energies
# differed by 2 to 5 % from drives over the true map, times by 1 to 2 %.
ENERGY_STD, TIME_STD = 0.03, 0.015


@dataclass(frozen=True)
class Ground:
    """The ground along n steps, (n,) each.

    resistance, slope: along the line, assumed where unknown. sum_std: deviation of their sum. confidence: NaN where
    unknown. unknown: nobody drove there; unmeasured: driven without resistance.
    """

    resistance: Floats
    slope: Floats
    resistance_std: Floats
    slope_std: Floats
    sum_std: Floats
    confidence: Floats
    unknown: Bools
    unmeasured: Bools


def ground_along(squares: Squares, cut: Steps, prices: Prices) -> Ground:
    """Ground along a line; unknown ground has its price.

    Unmeasured resistance is interpolated between measured neighbours. QueryError if all is unknown and has no given
    price.
    """
    along = squares.at(cut.position_m)
    east, north = cut.direction.T
    resistance, std = along["resistance_filled"], along["resistance_filled_std"]
    slope = along["grade_east_filled"] * east + along["grade_north_filled"] * north
    measured, flat = np.isfinite(resistance), ~np.isfinite(slope)
    driven = np.isfinite(along["visits"])
    unmeasured = ~measured & driven & measured.any()
    unknown = ~measured & ~unmeasured
    if unmeasured.any():
        between, differs = _between(resistance, measured)
        resistance = np.where(unmeasured, between, resistance)
        std = np.where(unmeasured, np.hypot(GAP_SHARE * between, differs / 2), std)
    if (bare := unknown | ~driven).any():
        if prices.given is None and unknown.all() and not np.isfinite(squares.layers["resistance_filled"]).any():
            raise QueryError(Refusal.OUT_OF_RANGE, "nobody has driven near this line yet: say what `unknown` ground is")
        wanted = squares_at(cut.position_m[bare], squares.cell_m, squares.edge)
        of_bare = prices.squares(wanted).at(cut.position_m)
        price, even = of_bare[RESISTANCE], of_bare[EAST] * east + of_bare[NORTH] * north
        std = np.where(unknown, UNKNOWN_SHARE * price, np.where(bare, np.hypot(std, price - resistance), std))
        resistance, slope = np.where(bare, price, resistance), np.where(bare & np.isfinite(even), even, slope)
    slope_std = np.where(flat, UNKNOWN_SLOPE_STD, along["grade_filled_std"])
    # machines measure the sum: errors of resistance and slope cancel
    alone = unknown | unmeasured | flat | ~driven
    return Ground(
        resistance=resistance,
        slope=np.nan_to_num(slope),
        resistance_std=std,
        slope_std=slope_std,
        sum_std=np.where(alone, np.hypot(std, slope_std), std),
        confidence=np.where(unknown, np.nan, along["confidence"]),
        unknown=unknown,
        unmeasured=unmeasured,
    )


def _between(resistance: Floats, measured: Bools) -> tuple[Floats, Floats]:
    """Resistance (n,) log-interpolated between measured steps, and the difference of these."""
    at, known = np.arange(len(resistance)), np.flatnonzero(measured)
    between = np.exp(np.interp(at, known, np.log(resistance[known])))
    after = np.searchsorted(known, at)
    before, behind = (resistance[known[np.clip(index, 0, len(known) - 1)]] for index in (after - 1, after))
    return between, np.abs(behind - before)


def line_std(ground: Ground, length_m: Floats) -> float:
    """Standard deviation of the mean of resistance plus slope; steps correlate by exp(-distance / ALIKE_M)."""
    weighted = ground.sum_std * length_m / float(length_m.sum())
    of_steps = _correlated(weighted, np.exp(-length_m / ALIKE_M))
    return math.sqrt(of_steps + line_variance(float(ground.resistance.mean())))


@numba.njit(cache=True, nogil=True)
def _correlated(std: Any, fade: Any) -> float:
    """Variance of a sum; each deviation (n,) correlates with its predecessors by its fade."""
    total, carried = 0.0, 0.0
    for i in range(len(std)):
        total += std[i] * std[i] + 2 * std[i] * carried
        carried = (carried + std[i]) * fade[i]
    return total


def route(
    line_m: Floats,
    squares: Squares,
    machine: RouteMachine,
    *,
    stops: tuple[bool, bool] = (True, True),
    step_m: float = 25.0,
    prices: Prices | None = None,
    refuse_unknown: bool = False,
) -> tuple[RouteSteps, RouteTotals]:
    """Cost of a drive along a line (k, 2), stopping at its ends or not.

    squares: LAYERS around the line. step_m: of the answer. prices: of these squares. QueryError if the power is too low
    or nothing is known.
    """
    cut = steps(line_m, STEP_M)
    ground = ground_along(squares, cut, prices or Prices(squares))
    if refuse_unknown and ground.unknown.any():
        x, y = cut.position_m[int(ground.unknown.argmax())]
        raise QueryError(
            Refusal.OUT_OF_RANGE, f"unknown ground at {x:.0f}, {y:.0f} m; without `unknown=refuse` it has a cost"
        )
    limit = limits(line_m, cut.end_m, machine.lateral_mps2)
    limit[[0, -1]] = np.where(stops, 0.0, limit[[0, -1]])
    resistance, slope = (smoothed(values, STEP_M) for values in (ground.resistance, ground.slope))
    done = drive(cut.length_m, resistance, slope, limit, machine)
    if done.stalls >= 0:
        x, y = cut.position_m[done.stalls]
        climbs = 100 * float(resistance[done.stalls] + slope[done.stalls])
        problem = (
            f"the machine cannot climb at {x:.0f}, {y:.0f} m: resistance and slope make {climbs:.1f} % of its weight"
        )
        raise QueryError(Refusal.OUT_OF_RANGE, f"{problem}; more `power`, less `mass` or another line")
    off = NINETY * line_std(ground, cut.length_m)
    low, high = (drive(cut.length_m, resistance + by, slope, limit, machine) for by in (-off, off))
    return _by_step(cut, ground, done, step_m), _totals(cut, ground, machine, done, (low, high))


def _totals(cut: Steps, ground: Ground, machine: RouteMachine, done: Drive, bounds: tuple[Drive, Drive]) -> RouteTotals:
    energy_j, time_s = float(done.energy_j.sum()), float(done.time_s.sum())
    low, high = bounds
    energy = _wider(energy_j, (float(low.energy_j.sum()), float(high.energy_j.sum())), ENERGY_STD)
    time = _wider(time_s, (float(low.time_s.sum()), float(high.time_s.sum())), TIME_STD)
    return RouteTotals(
        length_m=float(cut.length_m.sum()),
        lift_m=float((ground.slope * cut.length_m).sum()),
        unknown=float(ground.unknown.mean()),
        unmeasured=float(ground.unmeasured.mean()),
        unknown_resistance=float(ground.resistance[ground.unknown].mean()) if ground.unknown.any() else 0.0,
        energy_j=energy_j,
        energy_low_j=energy[0],
        energy_high_j=energy[1],
        braked_j=float(done.braked_j.sum()),
        fuel_j=energy_j / machine.efficiency,
        time_s=time_s,
        time_low_s=time[0],
        time_high_s=time[1],
    )


def _wider(value: float, bounds: tuple[float, float], share: float) -> tuple[float, float]:
    of_drives = NINETY * share * value
    low, high = (math.hypot(bound - value, of_drives) for bound in bounds)
    return value - low, value + high


def _by_step(cut: Steps, ground: Ground, done: Drive, step_m: float) -> RouteSteps:
    """Sum drive steps to answer steps, whole ones of about step_m."""
    n = max(1, round(cut.end_m[-1] / step_m))
    of_step = np.minimum(((cut.end_m[1:] - cut.length_m / 2) / cut.end_m[-1] * n).astype(int), n - 1)
    first = np.searchsorted(of_step, np.arange(n))
    length_m = np.add.reduceat(cut.length_m, first)

    def mean(values: Floats) -> Floats:
        known = np.isfinite(values)
        total = np.add.reduceat(np.where(known, values, 0.0) * cut.length_m, first)
        weight = np.add.reduceat(known * cut.length_m, first)
        return np.where(weight > 0, total / np.where(weight > 0, weight, 1.0), np.nan)

    time_s = np.add.reduceat(done.time_s, first)
    return RouteSteps(
        distance_m=np.cumsum(length_m),
        length_m=length_m,
        x_m=cut.position_m[first, 0],
        y_m=cut.position_m[first, 1],
        resistance=mean(ground.resistance),
        resistance_std=mean(ground.resistance_std),
        slope=mean(ground.slope),
        slope_std=mean(ground.slope_std),
        confidence=mean(ground.confidence),
        unknown=mean(ground.unknown.astype(float)),
        unmeasured=mean(ground.unmeasured.astype(float)),
        energy_j=np.add.reduceat(done.energy_j, first),
        braked_j=np.add.reduceat(done.braked_j, first),
        time_s=time_s,
        speed_mps=length_m / time_s,
    )
