"""Closed loops: a machine that returns to its starting point has climbed nothing, which shows the bias ahead.

    sum of (slope as measured) * distance  =  - bias * sum of distance          distances count down in reverse

The slope is the accelerometer's, less wheel acceleration: a filter's would lag behind ramps, and errors of that
acceleration cancel once the speed returns (acceleration over distance is half the change of squared speed). During a
shock, at the foot of a ramp or in wheel spin, accelerometer or wheels are wrong; then the filter's slope, by gyros, is
better. Distances are those of positions: they are level, and wheels slip uphill.

The machine marks each cell that it passes. A marked cell closes a loop: the loop's marks go, and the track continues
from the old mark. So each metre counts in one loop, nested ones included (loop erasure, Lawler 1980), and loops are
independent.
"""

import math
from dataclasses import dataclass

from agents.estimation.attitude import MAX_SINE
from agents.estimation.balance import MAX_GAP_NS, Balance
from agents.localisation.filters.belief import PoseBelief

STEP_M = 2.0  # wheel travel per step; shorter ones would add noise of positions
CELL_M = 2.0
LEAST_M = 60.0  # shorter loops show less than the data sheet
JUMP_M = 1.0  # mismatch of position and wheel travel, beside half the travel: not driven, or wheels spun
MAX_JOLT_S = 2.0  # a longer one is a broken accelerometer, or digging
MOST_STD_M = 3.0  # standard deviation beyond which a position closes no loop
KEPT = 5000  # marks: 10 km, an hour on a haul road
# Standard deviation of a loop's rise: unevenness where it closes, and per square root of a metre.
CLOSING_M, RISE_NOISE = 0.15, 0.013


@dataclass(frozen=True)
class Tour:
    """A closed loop: bias of the balance [-] and its standard deviation; distance_m: ahead less reverse."""

    stamp_ns: int
    zero: float
    std: float
    distance_m: float


@dataclass(frozen=True, slots=True)
class _Mark:
    """Sums up to a place: rise_m as measured, net_m ahead less reverse, driven_m both; the larger position variance."""

    rise_m: float = 0.0
    net_m: float = 0.0
    driven_m: float = 0.0
    variance_m2: float = 0.0


class ClosedTours:
    """Watches one machine. torn: how often the track was interrupted."""

    def __init__(self) -> None:
        self.torn = 0
        self._marks: dict[tuple[int, int], _Mark] = {}  # by cell, in track order
        self._sums = _Mark()
        self._last: Balance | None = None
        self._jolted_s = 0.0
        self._place_m = (0.0, 0.0)  # at the end of the last step
        self._step = (0.0, 0.0, 0.0)  # current step by the wheels: rise, travel, distance

    def update(self, balance: Balance, pose: PoseBelief | None, *, is_jolted: bool = False) -> Tour | None:
        """Add a balance at a pose (None interrupts the track); returns the loop it closes.

        is_jolted: whether a shock acts, or wheels slip.
        """
        last, self._last = self._last, balance
        self._jolted_s = self._jolted_s + balance.dt_s if is_jolted else 0.0
        is_lost = self._jolted_s > MAX_JOLT_S
        if pose is None or last is None or is_lost or balance.stamp_ns - last.stamp_ns > MAX_GAP_NS:
            self._begin(pose)
            return None
        driven_m = balance.distance_m - last.distance_m
        travel_m = balance.direction * driven_m
        sine = max(-MAX_SINE, min(MAX_SINE, math.sin(balance.slope_x) if is_jolted else balance.sine_x))
        rise, travel, distance = self._step
        self._step = rise + travel_m * math.tan(math.asin(sine)), travel + travel_m, distance + driven_m
        return self._end_step(balance, pose) if abs(self._step[1]) >= STEP_M else None

    def interrupt(self) -> None:
        """Separate what follows from what came before."""
        self._last = None

    def _begin(self, pose: PoseBelief | None) -> None:
        self.torn += bool(self._marks)
        self._marks.clear()
        self._sums, self._step = _Mark(), (0.0, 0.0, 0.0)
        if pose is None:
            self._last = None
        else:
            self._place_m = (pose.x_m, pose.y_m)

    def _end_step(self, balance: Balance, pose: PoseBelief) -> Tour | None:
        (rise_m, travel_m, driven_m), self._step = self._step, (0.0, 0.0, 0.0)
        moved_m = math.hypot(pose.x_m - self._place_m[0], pose.y_m - self._place_m[1])
        self._place_m = (pose.x_m, pose.y_m)
        if abs(moved_m - abs(travel_m)) > JUMP_M + abs(travel_m) / 2:
            self._begin(pose)
            return None
        scale, sums = moved_m / abs(travel_m), self._sums
        variance_m2 = float(max(pose.covariance_m2[0, 0], pose.covariance_m2[1, 1]))
        self._sums = _Mark(
            sums.rise_m + scale * rise_m, sums.net_m + scale * travel_m, sums.driven_m + driven_m, variance_m2
        )
        return self._pass_cell(balance, pose) if variance_m2 < MOST_STD_M**2 else None

    def _pass_cell(self, balance: Balance, pose: PoseBelief) -> Tour | None:
        cell, sums = (math.floor(pose.x_m / CELL_M), math.floor(pose.y_m / CELL_M)), self._sums
        mark = self._marks.setdefault(cell, sums)
        if len(self._marks) > KEPT:
            del self._marks[next(iter(self._marks))]
        tour = _tour(balance, mark, sums)
        if tour is None:
            return None
        while next(reversed(self._marks)) != cell:
            self._marks.popitem()
        self._sums = mark
        return tour


def _tour(balance: Balance, start: _Mark, end: _Mark) -> Tour | None:
    """The loop from a mark back to its cell; None if too short, or closed on a steep slope.

    There, heights within the cell differ too much; a later cell off the slope serves as well.
    """
    net_m, driven_m = end.net_m - start.net_m, end.driven_m - start.driven_m
    if abs(net_m) < LEAST_M:
        return None
    apart_m2 = CELL_M**2 / 6 + start.variance_m2 + end.variance_m2  # between two places in one cell, along an axis
    slope = math.hypot(math.tan(balance.slope_x), math.tan(balance.slope_y))
    by_slope_m2, by_distance_m2 = apart_m2 * slope**2, CLOSING_M**2 + RISE_NOISE**2 * driven_m
    if by_slope_m2 > by_distance_m2:
        return None
    std_m = math.sqrt(by_slope_m2 + by_distance_m2)
    return Tour(balance.stamp_ns, (start.rise_m - end.rise_m) / net_m, std_m / abs(net_m), net_m)
