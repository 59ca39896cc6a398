"""Samples: one per stretch, at the machine's place, with the ground estimate there.

A sample is made LAG_S late, so that the estimator has seen what follows. It has the filter's position and is pending;
with the smoother's position it becomes final.
"""

import math
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from agents.estimation.ground import GroundEstimate
from agents.localisation.filters.belief import PoseBelief
from protocol.arrays import Table
from protocol.machine.readings import FuelRate
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.rotations import wrap_angle
from protocol.units import HOUR_NS

NOTHING = np.empty(0, SAMPLE_DTYPE)
EVERY_M = 0.5  # distance between samples: a usual map cell
LAG_S = 2.0  # time for which ground still shows in the forces
MAX_STD_M = 20.0  # position deviation beyond which samples would blur the map
HISTORY_S = 30.0  # memory of poses: samples look back by LAG_S, withheld fixes by less
LAG_NS, HISTORY_NS = round(LAG_S * 1e9), round(HISTORY_S * 1e9)
SILENT_NS = 500_000_000  # silence after which wheels count as gone
MIN_SPEED_MPS = 0.3  # a slower filter speed is noise, not distance
_stamp = attrgetter("stamp_ns")


@dataclass(frozen=True)
class Mark:
    """A place to sample; distance_m, fuel_l: since the mark before."""

    stamp_ns: int
    distance_m: float
    fuel_l: float = math.nan


class FuelMeter:
    """Litres burnt while the machine moves: rate times time."""

    def __init__(self) -> None:
        self._newest: FuelRate | None = None
        self._litres = 0.0

    def add(self, reading: FuelRate, speed_mps: float) -> None:
        """Add a reading: the previous rate held until now, unless too old or at standstill."""
        before, self._newest = self._newest, reading
        if before is None:
            return
        span_ns = reading.stamp_ns - before.stamp_ns
        if not 0 < span_ns <= SILENT_NS:
            self._litres = math.nan  # for this stretch only
        elif abs(speed_mps) > MIN_SPEED_MPS:
            self._litres += before.litres_ph * span_ns / HOUR_NS

    def take(self, stamp_ns: int) -> float:
        """Litres since the last call; NaN if unknown."""
        is_fresh = self._newest and abs(stamp_ns - self._newest.stamp_ns) <= SILENT_NS
        litres, self._litres = self._litres if is_fresh else math.nan, 0.0
        return litres


@dataclass(frozen=True)
class SamplePlace:
    """Parts of a sample: mark, filter's pose, ground."""

    mark: Mark
    pose: PoseBelief
    estimate: GroundEstimate


class Samples(NamedTuple):
    """Samples of a step, in stamp order.

    pending: (n,), new, at the filter's position. final: (k,), final values of the oldest pending ones, perhaps of this
    step.
    """

    pending: Table
    final: Table


class PoseHistory:
    """Recent poses."""

    def __init__(self) -> None:
        self._poses: list[PoseBelief] = []

    @property
    def newest(self) -> PoseBelief | None:
        """The last pose."""
        return self._poses[-1] if self._poses else None

    def append(self, pose: PoseBelief) -> None:
        """Add a pose; it replaces those not older."""
        while self._poses and pose.stamp_ns <= self._poses[-1].stamp_ns:
            self._poses.pop()
        self._poses.append(pose)
        if pose.stamp_ns - self._poses[0].stamp_ns > 2 * HISTORY_NS:  # in bulk: removal in front is slow
            del self._poses[: bisect_left(self._poses, pose.stamp_ns - HISTORY_NS, key=_stamp)]

    def at(self, stamp_ns: int) -> PoseBelief | None:
        """Interpolated pose at a stamp; None if not remembered."""
        if not self._poses or not self._poses[0].stamp_ns <= stamp_ns <= self._poses[-1].stamp_ns:
            return None
        i = bisect_left(self._poses, stamp_ns, key=_stamp)
        if self._poses[i].stamp_ns == stamp_ns:
            return self._poses[i]
        return _interpolate(self._poses[i - 1], self._poses[i], stamp_ns)


class Odometer:
    """Total distance by wheels, or by the filter's speed while they are silent."""

    def __init__(self) -> None:
        self._distance_m = self._wheels_m = 0.0
        self._counted_ns = 0

    def update(self, now_ns: int, wheels_ns: int, wheels_m: float, speed_mps: float | None) -> float:
        """The distance so far [m].

        wheels_ns, wheels_m: newest wheel reading, and dead reckoning's distance. speed_mps: the filter's; without one
        dead reckoning counts, by GPS.
        """
        if speed_mps is None or now_ns - wheels_ns <= SILENT_NS:
            self._distance_m += wheels_m - self._wheels_m
        elif abs(speed_mps) > MIN_SPEED_MPS and self._counted_ns:
            self._distance_m += abs(speed_mps) * max(now_ns - self._counted_ns, 0) * 1e-9
        self._wheels_m, self._counted_ns = wheels_m, max(self._counted_ns, now_ns)
        return self._distance_m


class Sampler:
    """Makes samples; counts reasons in `withheld` and `without_resistance`.

    poses: of a proven heading. load_centre_m: lead of a sample over the pose.
    """

    def __init__(self, load_centre_m: float) -> None:
        self.withheld: Counter[str] = Counter()
        self.without_resistance: Counter[str] = Counter()
        self.poses = PoseHistory()
        self.is_clear: Callable[[int], bool] = lambda _: True  # whether the place at a stamp is
        self.fuel = FuelMeter()
        self._load_centre_m = load_centre_m
        self._marked_m = 0.0
        self._marks: deque[Mark] = deque()  # waiting for the estimator
        self._estimated: deque[tuple[Mark, GroundEstimate]] = deque()  # waiting for a pose
        self._pending: deque[SamplePlace] = deque()  # waiting for the smoother

    @property
    def waiting(self) -> int:
        """Number of marks not sampled."""
        return len(self._marks) + len(self._estimated)

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest sample not final."""
        return self._pending[0].pose.stamp_ns if self._pending else None

    @property
    def pending(self) -> int:
        """Number of samples not final."""
        return len(self._pending)

    def mark(self, stamp_ns: int, distance_m: float) -> None:
        """Note the total distance; every EVERY_M a sample is due."""
        since_m = distance_m - self._marked_m
        if since_m >= EVERY_M:
            self._marked_m = distance_m
            self._marks.append(Mark(stamp_ns, min(since_m, 2 * EVERY_M), self.fuel.take(stamp_ns)))

    def due_samples(self, now_ns: int, estimate_at: Callable[[int], GroundEstimate], *, waits: bool = True) -> Table:
        """Samples (n,) of marks with known ground and place; waits: only those LAG_S old."""
        while self._marks and self._marks[0].stamp_ns <= now_ns - LAG_NS * waits:
            mark = self._marks.popleft()
            self._estimated.append((mark, estimate_at(mark.stamp_ns)))
        newest = self.poses.newest
        if not self._estimated or not newest or self._estimated[0][0].stamp_ns > newest.stamp_ns:
            return NOTHING
        made: list[SamplePlace] = []
        while self._estimated and self._estimated[0][0].stamp_ns <= newest.stamp_ns:
            mark, estimate = self._estimated.popleft()
            pose = self.poses.at(mark.stamp_ns)
            if pose and self._is_usable(pose, estimate):
                made.append(SamplePlace(mark, pose, estimate))
            elif not pose:
                self.withheld["no_pose"] += 1
        self._pending += made
        return np.array([self._row(place, place.pose) for place in made], SAMPLE_DTYPE)

    def final_samples(self, corrected: Callable[[PoseBelief], PoseBelief | None]) -> Table:
        """Final values (n,) of the oldest pending samples. corrected: a smoothed pose, or None."""
        rows = []
        while self._pending and (pose := corrected(self._pending[0].pose)):
            rows.append(self._row(self._pending.popleft(), pose))
        return np.array(rows, SAMPLE_DTYPE) if rows else NOTHING

    def _is_usable(self, pose: PoseBelief, e: GroundEstimate) -> bool:
        if not self.is_clear(pose.stamp_ns):
            self.withheld["place_unclear"] += 1
            return False
        (xx, _), (_, yy) = pose.covariance_m2
        if max(xx, yy) > MAX_STD_M**2:
            self.withheld["unsure_position"] += 1
            return False
        if e.reason:
            self.without_resistance[e.reason] += 1
        return True

    def _row(self, place: SamplePlace, pose: PoseBelief) -> tuple[float, ...]:
        """The sample at a pose; load centre and gradient turn with the heading."""
        mark, e = place.mark, place.estimate
        (xx, xy), (_, yy) = pose.covariance_m2
        c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        x, y = pose.x_m + c * self._load_centre_m, pose.y_m + s * self._load_centre_m
        grade = (c * e.slope_x - s * e.slope_y, s * e.slope_x + c * e.slope_y, e.slope_var)
        at = (pose.stamp_ns, x, y, xx, xy, yy, pose.heading_rad, pose.speed_mps, mark.distance_m)
        return (*at, e.c_rr, e.c_rr_var, *grade, e.zero, e.scale, e.mass_kg, pose.aid_share, mark.fuel_l)


def joined(made: Sequence[Samples]) -> Samples:
    """Samples of several steps in one."""
    return Samples(*map(np.concatenate, zip(*made, strict=True))) if made else Samples(NOTHING, NOTHING)


def _interpolate(a: PoseBelief, b: PoseBelief, stamp_ns: int) -> PoseBelief:
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    heading = wrap_angle(a.heading_rad + share * wrap_angle(b.heading_rad - a.heading_rad))
    x, y = a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)
    speed = a.speed_mps + share * (b.speed_mps - a.speed_mps)
    covariance_m2 = a.covariance_m2 + share * (b.covariance_m2 - a.covariance_m2)
    return PoseBelief(stamp_ns, x, y, heading, speed, covariance_m2, a.aid_share + share * (b.aid_share - a.aid_share))
