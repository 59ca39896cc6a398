"""Replay readings through the pipeline, or through its localising half, and compare its poses with the truth.

A pose is compared at its own stamp, as it was known after the readings of that 100 ms: no later reading improves it.
Smoothed poses are what later readings made of it: they are compared at their own stamps too, once a second.
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
HOLE = 3  # times the usual interval between poses: nothing was believed in a longer one


@dataclass(frozen=True)
class Track:
    """Where a machine is said to have been.

    stamp_ns: (n,); position_m: (n, 2), covariance_m2: (n, 2, 2), heading_rad: (n,) in `map`.
    """

    stamp_ns: Ints
    position_m: Floats
    covariance_m2: Floats
    heading_rad: Floats

    def moved(self, lever_m: Floats) -> Self:
        """Of another point of the machine, lever_m (3,) off in `base_link`, as a machine on the plane has it.

        The covariance stays: what the heading adds, its standard deviation times the lever, is small beside it.
        """
        c, s, (ahead, left, _) = np.cos(self.heading_rad), np.sin(self.heading_rad), lever_m
        off = np.stack([c * ahead - s * left, s * ahead + c * left], axis=1)
        return replace(self, position_m=self.position_m + off)


NOWHERE = Track(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))


@dataclass(frozen=True)
class Trace(Track):
    """What was believed, once per STEP_NS from the first pose on.

    first_ns, last_ns: of the readings. cpu_s: processor time of whatever was run: the whole pipeline, or localisation
    alone. smoothed: what localisation alone says of the past in the end; empty of a pipeline, or without a smoother.
    """

    first_ns: int
    last_ns: int
    cpu_s: float
    smoothed: Track = NOWHERE

    @property
    def seconds(self) -> float:
        """How long the readings last."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def since_start_s(self) -> Floats:
        """Stamps (n,) as seconds after the first reading."""
        return np.asarray(self.stamp_ns - self.first_ns, float) * 1e-9

    def moved(self, lever_m: Floats) -> Self:
        """Of another point of the machine, as of any track."""
        return replace(super().moved(lever_m), smoothed=self.smoothed.moved(lever_m))


@dataclass(frozen=True)
class Score:
    """Errors of one run, counted from its first pose on.

    rmse_x_m, rmse_y_m, net_m: root mean squares; net is that of the distance. nees: mean, 2 where the covariance is
    right; nees_low, nees_high: its 95 % interval then. coverage95: share of time that the 95 % ellipse holds the truth.
    covered: share of time with a pose, as `covered` has it. us_per_second: processor time [us] per second of readings.
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
    """Give readings to a pipeline or to its localising half, in the order of their stamps; holdout keeps fixes back."""
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
    """Errors (n, 2) [m] of a track; NaN where the truth is not known."""
    return track.position_m - truth.at(track.stamp_ns)


def score(trace: Trace, truth: Truth) -> Score:
    """Errors of a trace, NaN where it has none."""
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
    """Errors (m, 2) of a track where the truth is known, and its NEES."""
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
    """Share of the time of the readings with a pose, at the log's own rate; 0 to 1.

    The time between two poses counts, and that from the first reading and to the last one; of a hole, one usual
    (median) interval.
    """
    if not len(trace.stamp_ns):
        return 0.0
    between_s = np.diff(trace.since_start_s)
    usual_s = float(np.median(between_s)) if len(between_s) else STEP_NS * 1e-9
    intervals_s = np.diff(trace.since_start_s, prepend=0.0, append=trace.seconds)
    counts_s = np.where(intervals_s <= HOLE * usual_s, intervals_s, usual_s)
    return min(1.0, float(counts_s.sum()) / trace.seconds) if trace.seconds else 1.0


def spans(readings: Sequence[Reading]) -> Iterator[list[Reading]]:
    """Cut readings at the multiples of STEP_NS; one whose stamp goes back stays with those that it came with."""
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
