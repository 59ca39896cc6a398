"""Closed tours: who is back where he was has risen by nothing, which shows the accelerometer's zero in one direction.

    sum of (slope as measured) * distance  =  - zero * sum of distance          distances count down in reverse

over any closed tour, with or without slopes. Slopes are those of the accelerometer alone, less the wheels'
acceleration: a filter's would lag behind the ramps, and what that acceleration is wrong by is gone when the speed is
what it was (acceleration summed over distance is half the change of the speed's square). A jolt is the exception, as at
the foot of a ramp or where wheels spin on sand: for this moment the accelerometer is at its end, or the wheels'
acceleration is none of the machine's, and the filter's slope, by the gyros, is the better one. Distances are those of
positions: they are level, and wheels slip uphill.

The machine leaves a mark in each cell that it passes. In a cell with a mark a tour is closed; then the marks of the
tour go, and the machine goes on from the old one. So every metre counts in one tour only, a tour inside of another one
too (the loop erasure of Lawler 1980), and what tours show is independent.
"""

import math
from dataclasses import dataclass

from agents.estimation.attitude import MAX_SINE
from agents.estimation.balance import MAX_GAP_NS, Balance
from agents.localisation.filters.belief import PoseBelief

STEP_M = 2.0  # of wheel travel; of shorter ones the noise of positions would be a part
CELL_M = 2.0
LEAST_M = 60.0  # a shorter tour shows less than the data sheet
JUMP_M = 1.0  # of a position against the wheels' travel, beside half of it: it was not driven, or wheels spun
MAX_JOLT_S = 2.0  # one that lasts longer is a broken accelerometer, or a machine that digs in
MOST_STD_M = 3.0  # a less sure position is no place to come back to
KEPT = 5000  # marks: 10 km, an hour on a haul road
# Standard deviation of the rise of a tour: of unevenness where it closes, and per root of a metre driven.
CLOSING_M, RISE_NOISE = 0.15, 0.013


@dataclass(frozen=True)
class Tour:
    """A closed tour: the zero of the balance [-] by it, with its standard deviation; distance_m: ahead less reverse."""

    stamp_ns: int
    zero: float
    std: float
    distance_m: float


@dataclass(frozen=True, slots=True)
class _Mark:
    """Sums up to a place, with the variance of the position [m2], the larger one of both axes.

    rise_m: as measured. net_m: driven ahead less in reverse. driven_m: both.
    """

    rise_m: float = 0.0
    net_m: float = 0.0
    driven_m: float = 0.0
    variance_m2: float = 0.0


class ClosedTours:
    """Watches one machine. torn: how often the track could not be followed, and began anew."""

    def __init__(self) -> None:
        self.torn = 0
        self._marks: dict[tuple[int, int], _Mark] = {}  # by cell, in the order of the track
        self._sums = _Mark()
        self._last: Balance | None = None
        self._jolted_s = 0.0
        self._place_m = (0.0, 0.0)  # at the end of the last step
        self._step = (0.0, 0.0, 0.0)  # under way, by the wheels: rise, travel, distance

    def update(self, balance: Balance, pose: PoseBelief | None, *, is_jolted: bool = False) -> Tour | None:
        """Add a balance at a pose; returns the tour that it closes. Without a pose there is no track to follow.

        is_jolted: whether forces act that are no slope, or the wheels slip.
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
        """What follows cannot be joined to what was before."""
        self._last = None

    def _begin(self, pose: PoseBelief | None) -> None:
        """Forget the track, and begin anew here."""
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
        """Leave a mark in this cell, or close a tour if there is one."""
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
    """What a tour from a mark back to its cell shows; None where it is too short, or would close on a steep slope.

    There the two places in the cell may differ by more height than all else; a cell after the slope serves as well.
    """
    net_m, driven_m = end.net_m - start.net_m, end.driven_m - start.driven_m
    if abs(net_m) < LEAST_M:
        return None
    apart_m2 = CELL_M**2 / 6 + start.variance_m2 + end.variance_m2  # of two places in one cell, along an axis
    slope = math.hypot(math.tan(balance.slope_x), math.tan(balance.slope_y))
    by_slope_m2, by_distance_m2 = apart_m2 * slope**2, CLOSING_M**2 + RISE_NOISE**2 * driven_m
    if by_slope_m2 > by_distance_m2:
        return None
    std_m = math.sqrt(by_slope_m2 + by_distance_m2)
    return Tour(balance.stamp_ns, (start.rise_m - end.rise_m) / net_m, std_m / abs(net_m), net_m)
