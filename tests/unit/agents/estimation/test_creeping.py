"""Creeping machines: the slowest speed with estimates follows from wheel resolution and noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.dead_reckoning import WheelTracker
from protocol.machine.readings import Encoder
from tests.unit.agents.drives import Ground, Leg, changed_sensor, drive, machine
from tests.unit.agents.ground import EstimatorRun

RADIUS_M = 0.75


def tracked(ticks_per_rev: float, speed_mps: float) -> tuple[WheelTracker, np.ndarray]:
    """A wheel at steady speed for a minute: tracker, speeds."""
    tracker, tick_m, speeds = WheelTracker(), 2 * math.pi * RADIUS_M / ticks_per_rev, []
    for i in range(1, 1200):
        tracker.update(i * 50_000_000, math.floor(i * 0.05 * speed_mps / tick_m) * tick_m)
        speeds.append(tracker.speed_mps)
    return tracker, np.array(speeds)


@pytest.mark.parametrize("ticks_per_rev", [16, 100, 1000])
@pytest.mark.parametrize("speed_mps", [0.53, 3.9])
def test_a_wheel_states_how_unsure_its_speed_is(ticks_per_rev: float, speed_mps: float) -> None:
    tracker, speeds = tracked(ticks_per_rev, speed_mps)
    true = float(np.std(speeds[100:] - speed_mps))
    assert 0.7 * true < tracker.std_mps < 2.2 * true  # larger where ticks are rarer than readings


def test_a_wheel_that_stands_does_not_become_surer() -> None:
    tracker, _ = tracked(100, 1.0)
    before, travel_m = tracker.std_mps, math.floor(1199 * 0.05 / 0.0471) * 0.0471
    tracker.update(1200 * 50_000_000, travel_m)
    stands = tracker.std_mps
    for i in range(1201, 3000):
        tracker.update(i * 50_000_000, travel_m)
    assert tracker.std_mps == stands == pytest.approx(before, rel=0.2)


@pytest.mark.parametrize(
    ("ticks_per_rev", "speed_mps", "knows"), [(2000, 0.1, True), (100, 0.1, False), (100, 0.45, True)]
)
def test_creeping_ground_is_known_as_far_as_the_wheels_show_it(
    ticks_per_rev: int, speed_mps: float, knows: bool
) -> None:
    vehicle = changed_sensor(machine(), "wheels", ticks_per_rev=ticks_per_rev)
    made = drive([Leg(2), Leg(2, speed_mps / 2), Leg(30)], vehicle, ground=Ground(0.06))
    ticking = [
        replace(r, left_ticks=math.floor(r.left_ticks), right_ticks=math.floor(r.right_ticks))
        if isinstance(r, Encoder)
        else r
        for r in made.readings
    ]
    estimates = EstimatorRun(vehicle).feed(ticking).between(12, 30)
    if knows:
        assert sum(not e.reason for e in estimates) > 0.9 * len(estimates)
        assert np.nanmean([e.c_rr for e in estimates]) == pytest.approx(0.06, abs=0.004)
    else:
        assert sum(e.reason == "standstill" for e in estimates) > 0.5 * len(estimates)
