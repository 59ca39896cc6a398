"""Samples: one per stretch driven, at the place where the machine was, with the estimate of the ground there.

A sample is made LAG_S later than the machine was there, so that the estimator has seen what came next. It has the
filter's position then, and is pending; once the smoother has its word on that place, it is made again, final.
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
EVERY_M = 0.5  # driven from one sample to the next: a cell of the map at its usual size
LAG_S = 2.0  # the ground under the wheels shows in the forces for about so long
MAX_STD_M = 20.0  # samples of a position less sure than this are withheld: they would blur the map
HISTORY_S = 30.0  # how long poses are kept: a sample looks back by LAG_S, and a withheld fix by less
LAG_NS, HISTORY_NS = round(LAG_S * 1e9), round(HISTORY_S * 1e9)
SILENT_NS = 500_000_000  # wheels without a reading for so long are taken to be gone
MIN_SPEED_MPS = 0.3  # a slower speed of the filter alone is noise, not distance
_stamp = attrgetter("stamp_ns")


@dataclass(frozen=True)
class Mark:
    """A place to sample: where the machine was at stamp_ns, after distance_m and fuel_l since the mark before."""

    stamp_ns: int
    distance_m: float
    fuel_l: float = math.nan


class FuelMeter:
    """Litres that an engine burns while its machine moves: rate times time, by the newest reading."""

    def __init__(self) -> None:
        self._newest: FuelRate | None = None
        self._litres = 0.0

    def add(self, reading: FuelRate, speed_mps: float) -> None:
        """Take in a reading: the rate before it held until now, unless it is too old or the machine stands."""
        before, self._newest = self._newest, reading
        if before is None:
            return
        span_ns = reading.stamp_ns - before.stamp_ns
        if not 0 < span_ns <= SILENT_NS:
            self._litres = math.nan  # of this stretch; the next one is known again
        elif abs(speed_mps) > MIN_SPEED_MPS:
            self._litres += before.litres_ph * span_ns / HOUR_NS

    def take(self, stamp_ns: int) -> float:
        """Litres since it was asked last; NaN where no reading says so."""
        is_fresh = self._newest and abs(stamp_ns - self._newest.stamp_ns) <= SILENT_NS
        litres, self._litres = self._litres if is_fresh else math.nan, 0.0
        return litres


@dataclass(frozen=True)
class SamplePlace:
    """What a sample is made of: its mark, where the filter saw the machine, and the ground there."""

    mark: Mark
    pose: PoseBelief
    estimate: GroundEstimate


class Samples(NamedTuple):
    """Samples that a step made, in the order of their stamps.

    pending: (n,), new ones at the filter's position. final: (k,), the last words on those that were made first and had
    none so far; they may be of the same step.
    """

    pending: Table
    final: Table


class PoseHistory:
    """Recent poses, to look up where the machine was."""

    def __init__(self) -> None:
        self._poses: list[PoseBelief] = []

    @property
    def newest(self) -> PoseBelief | None:
        """The last pose."""
        return self._poses[-1] if self._poses else None

    def append(self, pose: PoseBelief) -> None:
        """Add a pose; it replaces those that are not older."""
        while self._poses and pose.stamp_ns <= self._poses[-1].stamp_ns:
            self._poses.pop()
        self._poses.append(pose)
        if pose.stamp_ns - self._poses[0].stamp_ns > 2 * HISTORY_NS:  # in bulk: removing in front is slow
            del self._poses[: bisect_left(self._poses, pose.stamp_ns - HISTORY_NS, key=_stamp)]

    def at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a stamp, interpolated; None outside of what is remembered."""
        if not self._poses or not self._poses[0].stamp_ns <= stamp_ns <= self._poses[-1].stamp_ns:
            return None
        i = bisect_left(self._poses, stamp_ns, key=_stamp)
        if self._poses[i].stamp_ns == stamp_ns:
            return self._poses[i]
        return _interpolate(self._poses[i - 1], self._poses[i], stamp_ns)


class Odometer:
    """Counts the distance driven, up in reverse too: by the wheels, or by the filter's speed while they are silent."""

    def __init__(self) -> None:
        self._distance_m = self._wheels_m = 0.0
        self._counted_ns = 0

    def update(self, now_ns: int, wheels_ns: int, wheels_m: float, speed_mps: float | None) -> float:
        """The distance [m] by now.

        wheels_ns, wheels_m: stamp of the newest wheel reading, and the distance of dead reckoning. speed_mps: the
        filter's; None before it has one, then dead reckoning counts, by GPS.
        """
        if speed_mps is None or now_ns - wheels_ns <= SILENT_NS:
            self._distance_m += wheels_m - self._wheels_m
        elif abs(speed_mps) > MIN_SPEED_MPS and self._counted_ns:
            self._distance_m += abs(speed_mps) * max(now_ns - self._counted_ns, 0) * 1e-9
        self._wheels_m, self._counted_ns = wheels_m, max(self._counted_ns, now_ns)
        return self._distance_m


class Sampler:
    """Makes samples; counts by reason what is `withheld` and what is sampled `without_resistance`.

    poses: where the machine was, of a heading that is proven. fuel: what it burns. load_centre_m: how far ahead of the
    pose a sample lies.
    """

    def __init__(self, load_centre_m: float) -> None:
        self.withheld: Counter[str] = Counter()
        self.without_resistance: Counter[str] = Counter()
        self.poses = PoseHistory()
        self.is_clear: Callable[[int], bool] = lambda _: True  # whether the place of a stamp is
        self.fuel = FuelMeter()
        self._load_centre_m = load_centre_m
        self._marked_m = 0.0
        self._marks: deque[Mark] = deque()  # wait for the estimator
        self._estimated: deque[tuple[Mark, GroundEstimate]] = deque()  # wait for a pose
        self._pending: deque[SamplePlace] = deque()  # sampled, wait for the smoother

    @property
    def waiting(self) -> int:
        """How many marks are not sampled yet."""
        return len(self._marks) + len(self._estimated)

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest sample that is not final yet."""
        return self._pending[0].pose.stamp_ns if self._pending else None

    @property
    def pending(self) -> int:
        """How many samples are not final yet."""
        return len(self._pending)

    def mark(self, stamp_ns: int, distance_m: float) -> None:
        """Note the distance driven so far, up in reverse too: every EVERY_M a sample becomes due."""
        since_m = distance_m - self._marked_m
        if since_m >= EVERY_M:
            self._marked_m = distance_m
            self._marks.append(Mark(stamp_ns, min(since_m, 2 * EVERY_M), self.fuel.take(stamp_ns)))

    def due_samples(self, now_ns: int, estimate_at: Callable[[int], GroundEstimate], *, waits: bool = True) -> Table:
        """Samples (n,) of all marks whose ground and place are known; waits: only of those that are LAG_S old."""
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
        """Final values (n,) of the oldest pending samples. corrected: a pose as smoothed, None while not known."""
        rows = []
        while self._pending and (pose := corrected(self._pending[0].pose)):
            rows.append(self._row(self._pending.popleft(), pose))
        return np.array(rows, SAMPLE_DTYPE) if rows else NOTHING

    def _is_usable(self, pose: PoseBelief, e: GroundEstimate) -> bool:
        """Whether a sample can be made of it; counts why not, and what it lacks."""
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
        """The sample of a place, with the machine in this pose: load centre and gradient turn with its heading."""
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
