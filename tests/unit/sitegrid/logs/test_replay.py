"""Replay and score of beliefs with known errors."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import PoseBelief
from protocol.machine.readings import Articulation, Reading
from sitegrid.logs.replay import STEP_NS, Trace, Track, covered, replay, score
from sitegrid.proof.tracks import Truth

START_NS = 1_767_225_600_000_000_000


def trace_of(error_m: Sequence[tuple[float, float]], std_m: float = 1.0, before: int = 0) -> tuple[Trace, Truth]:
    """One belief per step beside an eastward truth at 1 m/s, after `before` empty steps."""
    n = len(error_m)
    stamps = START_NS + (np.arange(before + n + 1)) * STEP_NS
    true = np.stack([np.arange(before + n + 1) * 0.1, np.zeros(before + n + 1)], axis=1)
    believed = true[before + 1 :] + np.array(error_m)
    covariance = np.broadcast_to(np.eye(2) * std_m**2, (n, 2, 2))
    trace = Trace(stamps[before + 1 :], believed, covariance, np.zeros(n), START_NS, int(stamps[-1]), cpu_s=0.01)
    return trace, Truth(stamps, true)


class Scripted:
    """A pipeline stand-in with poses from the second reading on, at the readings' stamps."""

    def __init__(self) -> None:
        self.spans: list[list[Reading]] = []
        self.pose: PoseBelief | None = None

    def step(self, readings: list[Reading]) -> None:
        self.spans.append(readings)
        if len(self.spans) > 1 and readings:
            self.pose = PoseBelief(readings[-1].stamp_ns, 1.0, 2.0, 0.0, 0.0, np.eye(2))


def test_errors_per_axis_and_their_net():
    result = score(*trace_of([(3.0, 0.0), (0.0, 4.0)]))
    squares = (result.rmse_x_m**2, result.rmse_y_m**2, result.net_m**2)
    assert squares == pytest.approx((4.5, 8.0, 12.5))
    assert (result.max_m, result.nees) == pytest.approx((4.0, 12.5))
    assert result.coverage95 == 0.0
    assert result.us_per_second == pytest.approx(0.01e6 / 0.2)


def test_time_without_a_pose_is_stated_and_not_counted_as_error():
    result = score(*trace_of([(1.0, 0.0)] * 30, before=10))
    assert result.covered == pytest.approx(0.75)
    assert result.net_m == pytest.approx(1.0)


def poses_at(times_s: Sequence[float], seconds: float) -> Trace:
    """Poses at these times, and the readings' duration."""
    stamps, n = START_NS + np.round(np.array(times_s) * 1e9).astype(np.int64), len(times_s)
    return Trace(
        stamps, np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n), START_NS, START_NS + round(seconds * 1e9), 0.0
    )


@pytest.mark.parametrize("rate_hz", [0.5, 1.0, 5.0, 7.3, 10.0])
def test_a_slow_log_is_covered_wholly_at_its_own_rate(rate_hz: float):
    times = np.arange(200) / rate_hz
    assert covered(poses_at(times, times[-1])) == pytest.approx(1.0)
    jittered = np.sort(times + np.random.default_rng(5).uniform(-0.4, 0.4, 200) / rate_hz)
    assert covered(poses_at(jittered[1:], jittered[-1])) > 0.99


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0])
def test_a_hole_in_a_slow_log_is_not_covered(rate_hz: float):
    times = [t for t in np.arange(0, 100, 1 / rate_hz) if not 40 < t < 60]
    assert covered(poses_at(times, times[-1])) == pytest.approx(0.8, abs=2 / rate_hz / 100)
    assert covered(poses_at([t for t in times if t >= 60], 100.0)) == pytest.approx(0.4, abs=2 / rate_hz / 100)


def test_smoothed_poses_are_judged_at_their_own_stamps():
    trace, truth = trace_of([(3.0, 0.0)] * 40, std_m=2.0)
    every = slice(None, None, 10)
    off_m = np.array([(0.0, 1.0)] * 4)
    smoothed = Track(
        trace.stamp_ns[every],
        trace.position_m[every] - (3.0, 0.0) + off_m,
        trace.covariance_m2[every] / 4,
        trace.heading_rad[every],
    )
    result = score(replace(trace, smoothed=smoothed), truth)
    assert (result.net_m, result.nees) == pytest.approx((3.0, 2.25))
    assert (result.smoothed_net_m, result.smoothed_nees, result.smoothed_coverage95) == pytest.approx((1.0, 1.0, 1.0))
    assert math.isnan(score(trace, truth).smoothed_net_m)


def test_a_belief_is_taken_once_per_step_with_nothing_that_came_later():
    readings = [Articulation("joint", START_NS + i * STEP_NS // 4, 0.0) for i in range(12)]
    pipeline: Any = Scripted()
    trace = replay(pipeline, readings)
    assert [len(span) for span in pipeline.spans] == [4, 4, 4]
    assert trace.stamp_ns.tolist() == [readings[7].stamp_ns, readings[11].stamp_ns]
    assert trace.covariance_m2.shape == (2, 2, 2)
    assert trace.seconds == pytest.approx(0.275)
