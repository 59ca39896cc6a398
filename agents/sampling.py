"""When and where a sample is made: one per stretch driven, placed where the ground produced the estimate."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from agents.estimation.ground import GroundEstimate
from agents.localisation.belief import PoseBelief
from protocol.arrays import Table
from protocol.samples import SAMPLE_DTYPE

NOTHING = np.empty(0, SAMPLE_DTYPE)


@dataclass(frozen=True)
class SamplingConfig:
    """When samples are made.

    every_m: one sample per so many metres driven. lag_s: how long ago the ground produced an estimate.
    max_pitch_rate_radps: while the slope changes faster, samples are withheld. max_std_m: samples of a position less
    sure than this are withheld. history_s: how long poses are remembered.
    """

    every_m: float = 0.5
    lag_s: float = 0.6
    max_pitch_rate_radps: float = 0.026
    max_std_m: float = 20.0
    history_s: float = 30.0

    def __post_init__(self) -> None:
        for name in set(self.__dataclass_fields__) - {"lag_s"}:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")
        if not 0 <= self.lag_s < self.history_s:
            raise ValueError("lag_s: not between 0 and history_s")


@dataclass(frozen=True)
class Mark:
    """An estimate that wants a place: made at stamp_ns, after distance_m more metres driven."""

    stamp_ns: int
    distance_m: float
    estimate: GroundEstimate


class PoseHistory:
    """Recent poses, to look up where the machine was."""

    def __init__(self, history_s: float) -> None:
        self._poses: list[PoseBelief] = []
        self._history_ns = round(history_s * 1e9)

    @property
    def newest(self) -> PoseBelief | None:
        """The last pose."""
        return self._poses[-1] if self._poses else None

    def append(self, pose: PoseBelief) -> None:
        """Remember a pose; it replaces those that are not older."""
        while self._poses and pose.stamp_ns <= self._poses[-1].stamp_ns:
            self._poses.pop()
        self._poses.append(pose)
        if pose.stamp_ns - self._poses[0].stamp_ns > 2 * self._history_ns:  # in bulk: removing in front is slow
            del self._poses[: bisect_left(self._poses, pose.stamp_ns - self._history_ns, key=_stamp)]

    def at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a stamp, interpolated; None outside of what is remembered."""
        if not self._poses or not self._poses[0].stamp_ns <= stamp_ns <= self._poses[-1].stamp_ns:
            return None
        i = bisect_left(self._poses, stamp_ns, key=_stamp)
        if self._poses[i].stamp_ns == stamp_ns:
            return self._poses[i]
        return _interpolate(self._poses[i - 1], self._poses[i], stamp_ns)


class Sampler:
    """Makes samples from estimates and poses. `withheld` counts what was not sampled, by reason."""

    def __init__(self, load_centre_m: float, config: SamplingConfig) -> None:
        self.withheld: Counter[str] = Counter()
        self.poses = PoseHistory(config.history_s)
        self._load_centre_m = load_centre_m
        self._config = config
        self._way_m = 0.0
        self._marks: deque[Mark] = deque()

    @property
    def waiting(self) -> int:
        """How many marks have no place yet."""
        return len(self._marks)

    def is_due(self, way_m: float) -> bool:
        """Whether the machine has driven far enough since the last mark; way_m counts up in reverse too."""
        return way_m - self._way_m >= self._config.every_m

    def mark(self, stamp_ns: int, way_m: float, estimate: GroundEstimate) -> None:
        """Note an estimate that is due."""
        distance_m = way_m - self._way_m
        self._way_m = way_m
        if abs(estimate.pitch_rate_radps) > self._config.max_pitch_rate_radps:
            self.withheld["pitch_transient"] += 1
            return
        self._marks.append(Mark(stamp_ns, min(distance_m, 2 * self._config.every_m), estimate))

    def take(self) -> Table:
        """Samples (n,) of all marks whose place is known by now."""
        newest = self.poses.newest
        if not self._marks or not newest or self._place_ns(self._marks[0]) > newest.stamp_ns:
            return NOTHING
        rows = []
        while self._marks and self._place_ns(self._marks[0]) <= newest.stamp_ns:
            mark = self._marks.popleft()
            if pose := self.poses.at(self._place_ns(mark)):
                rows += self._sample(mark, pose)
            else:
                self.withheld["no_pose"] += 1
        return np.array(rows, SAMPLE_DTYPE)

    def _place_ns(self, mark: Mark) -> int:
        return mark.stamp_ns - round(self._config.lag_s * 1e9)

    def _sample(self, mark: Mark, pose: PoseBelief) -> list[tuple[float, ...]]:
        (xx, xy), (_, yy) = pose.covariance_m2
        if max(xx, yy) > self._config.max_std_m**2:
            self.withheld["unsure_position"] += 1
            return []
        c, s, e = math.cos(pose.heading_rad), math.sin(pose.heading_rad), mark.estimate
        x, y = pose.x_m + c * self._load_centre_m, pose.y_m + s * self._load_centre_m
        grade = (c * e.slope_x - s * e.slope_y, s * e.slope_x + c * e.slope_y, e.slope_var)
        place = (pose.stamp_ns, x, y, xx, xy, yy, pose.heading_rad, pose.speed_mps, mark.distance_m)
        return [(*place, e.c_rr, e.c_rr_var, *grade)]


def _stamp(pose: PoseBelief) -> int:
    return pose.stamp_ns


def _interpolate(a: PoseBelief, b: PoseBelief, stamp_ns: int) -> PoseBelief:
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    turn = (b.heading_rad - a.heading_rad + math.pi) % (2 * math.pi) - math.pi
    heading = (a.heading_rad + share * turn + math.pi) % (2 * math.pi) - math.pi
    x, y = a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m)
    speed = a.speed_mps + share * (b.speed_mps - a.speed_mps)
    return PoseBelief(stamp_ns, x, y, heading, speed, a.covariance_m2 + share * (b.covariance_m2 - a.covariance_m2))
