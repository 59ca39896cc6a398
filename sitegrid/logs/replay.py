"""Replay readings through the pipeline, or localisation alone, and compare poses with the truth.

A pose is compared at its stamp, as known after that 100 ms of readings. Smoothed poses, improved by later readings, are
compared at their stamps once a second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from agents.holdout import Holdout
from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from agents.pipeline import PoseSource
from agents.positioning import Positioning
from protocol.arrays import Floats, Ints
from protocol.machine.readings import Reading
from sitegrid.logs.consistency import ConsistencySummary, normalised_square, summarise
from sitegrid.proof.figures import root_mean_square
from sitegrid.proof.tracks import Truth

STEP_NS = 100_000_000
HOLE = 3  # usual pose intervals; longer ones are gaps


@dataclass(frozen=True)
class Track:
    """Estimated track of a machine.

    stamp_ns: (n,); position_m: (n, 2), covariance_m2: (n, 2, 2), heading_rad: (n,) in `map`.
    """

    stamp_ns: Ints
    position_m: Floats
    covariance_m2: Floats
    heading_rad: Floats

    def moved(self, lever_m: Floats) -> Self:
        """The track of another point, lever_m (3,) off in `base_link`, machine level.

        The covariance is kept: heading error times lever is negligible.
        """
        c, s, (ahead, left, _) = np.cos(self.heading_rad), np.sin(self.heading_rad), lever_m
        off = np.stack([c * ahead - s * left, s * ahead + c * left], axis=1)
        return replace(self, position_m=self.position_m + off)


NOWHERE = Track(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))


@dataclass(frozen=True)
class Trace(Track):
    """Estimates as of their time, one per STEP_NS from the first pose.

    first_ns, last_ns: of the readings. cpu_s: of the replay, pipeline or localisation alone. smoothed: of localisation
    alone; else empty.
    """

    first_ns: int
    last_ns: int
    cpu_s: float
    smoothed: Track = NOWHERE

    @property
    def seconds(self) -> float:
        """Duration of the readings."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def since_start_s(self) -> Floats:
        """Stamps (n,) in seconds after the first reading."""
        return np.asarray(self.stamp_ns - self.first_ns, float) * 1e-9

    def moved(self, lever_m: Floats) -> Self:
        """The trace of another point."""
        return replace(super().moved(lever_m), smoothed=self.smoothed.moved(lever_m))


@dataclass(frozen=True)
class Score:
    """Errors of one run from its first pose.

    rmse_x_m, rmse_y_m, net_m: root mean squares; net: of the distance. nees: mean, 2 if consistent; nees_low,
    nees_high: its 95 % interval if consistent. coverage95: share of time with the truth in the 95 % ellipse. covered:
    see `covered`. us_per_second: processor time [us] per second of readings.
    """

    rmse_x_m: float
    rmse_y_m: float
    net_m: float
    max_m: float
    nees: float
    nees_low: float
    nees_high: float
    coverage95: float
    covered: float
    us_per_second: float
    smoothed_net_m: float
    smoothed_nees: float
    smoothed_coverage95: float


def replay(core: PoseSource, readings: Sequence[Reading], holdout: Holdout | None = None) -> Trace:
    """Replay readings by stamp into a pipeline or localisation alone; holdout withholds fixes."""
    poses: list[PoseBelief] = []
    smoothed: list[SmoothedPose] = []
    cpu_s = 0.0
    for span in spans(readings):
        seen = holdout.split(span) if holdout else span
        began_s = time.process_time()
        if isinstance(core, Positioning):
            smoothed += core.step(seen)
        else:
            core.step(seen)
        pose = core.pose
        cpu_s += time.process_time() - began_s
        if holdout:
            holdout.compare(core)
        if pose and (not poses or pose.stamp_ns > poses[-1].stamp_ns):
            poses.append(pose)
    if isinstance(core, Positioning):
        smoothed += core.remaining()
    first_ns, last_ns = (readings[0].stamp_ns, readings[-1].stamp_ns) if readings else (0, 0)
    return Trace(**vars(_track(poses)), first_ns=first_ns, last_ns=last_ns, cpu_s=cpu_s, smoothed=_track(smoothed))


def errors(track: Track, truth: Truth) -> Floats:
    """Errors (n, 2) [m] of a track; NaN where the truth is unknown."""
    return track.position_m - truth.at(track.stamp_ns)


def score(trace: Trace, truth: Truth) -> Score:
    """Errors of a trace; NaN if empty."""
    off, nees = _judged(trace, truth)
    smoothed_off, smoothed_nees = _judged(trace.smoothed, truth)
    x, y = (root_mean_square(column) for column in off.T)
    return Score(
        rmse_x_m=x,
        rmse_y_m=y,
        net_m=math.hypot(x, y),
        max_m=float(np.hypot(*off.T).max()) if len(off) else math.nan,
        nees=nees.mean,
        nees_low=nees.low,
        nees_high=nees.high,
        coverage95=nees.coverage,
        covered=covered(trace),
        us_per_second=trace.cpu_s * 1e6 / trace.seconds if trace.seconds else math.nan,
        smoothed_net_m=root_mean_square(np.hypot(*smoothed_off.T)),
        smoothed_nees=smoothed_nees.mean,
        smoothed_coverage95=smoothed_nees.coverage,
    )


def _judged(track: Track, truth: Truth) -> tuple[Floats, ConsistencySummary]:
    """Errors (m, 2) where the truth is known, and their NEES."""
    off = errors(track, truth)
    known = np.isfinite(off).all(axis=1)
    off = off[known]
    return off, summarise(normalised_square(off, track.covariance_m2[known]), dof=2)


def _track(poses: Sequence[PoseBelief] | Sequence[SmoothedPose]) -> Track:
    return Track(
        stamp_ns=np.array([p.stamp_ns for p in poses], np.int64),
        position_m=np.array([(p.x_m, p.y_m) for p in poses]).reshape(-1, 2),
        covariance_m2=np.array([p.covariance_m2 for p in poses]).reshape(-1, 2, 2),
        heading_rad=np.array([p.heading_rad for p in poses]),
    )


def covered(trace: Trace) -> float:
    """Share of the readings' time with a pose, 0 to 1, at the log's own rate.

    All intervals count, including those before the first and after the last pose; of a gap only one median interval.
    """
    if not len(trace.stamp_ns):
        return 0.0
    between_s = np.diff(trace.since_start_s)
    usual_s = float(np.median(between_s)) if len(between_s) else STEP_NS * 1e-9
    intervals_s = np.diff(trace.since_start_s, prepend=0.0, append=trace.seconds)
    counts_s = np.where(intervals_s <= HOLE * usual_s, intervals_s, usual_s)
    return min(1.0, float(counts_s.sum()) / trace.seconds) if trace.seconds else 1.0


def spans(readings: Sequence[Reading]) -> Iterator[list[Reading]]:
    """Split readings at multiples of STEP_NS; a late reading stays in the span it arrived in."""
    span: list[Reading] = []
    step = 0
    for reading in readings:
        if span and reading.stamp_ns // STEP_NS > step:
            yield span
            span = []
        step = max(step, reading.stamp_ns // STEP_NS)
        span.append(reading)
    if span:
        yield span
