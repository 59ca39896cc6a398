import math
from collections.abc import Sequence

import numpy as np
import pytest

from agents.estimation.attitude import SlopeFilter
from protocol.units import GRAVITY_MPS2

STEP_S = 0.05
LEVEL, STANDING, STRAIGHT = (0.0, 0.0), (0.0, 0.0), (0.0, 0.0, 0.0)


def started(ahead_rad: float = 0.0, left_rad: float = 0.0) -> SlopeFilter:
    slope = SlopeFilter()
    slope.update(STEP_S, STRAIGHT, force(ahead_rad, left_rad), STANDING)
    return slope


def force(ahead_rad: float, left_rad: float) -> tuple[float, float]:
    return GRAVITY_MPS2 * math.sin(ahead_rad), GRAVITY_MPS2 * math.sin(left_rad)


def angles(slope: SlopeFilter) -> tuple[float, float]:
    return math.asin(slope.ahead), math.asin(slope.left)


def circle(slope: SlopeFilter, seconds: int, zero: tuple[float, float], tilt: float) -> float:
    """Circle on a plane rising by sine `tilt` to the east, first heading east, with zeros over g; returns the last
    heading.

    Turns and straights of 5 s: a gyro bias resembles a zero only while turning.
    """
    heading = 0.0
    for i in range(round(seconds / STEP_S)):
        radps = 0.0 if round(i * STEP_S) // 5 % 2 else 0.4
        mean = heading + 0.5 * radps * STEP_S  # forces are means over the step
        sines = tilt * math.cos(mean), -tilt * math.sin(mean)
        forces = [GRAVITY_MPS2 * (sine + z) for sine, z in zip(sines, zero, strict=True)]
        slope.update(STEP_S, (0.0, 0.0, radps), forces, STANDING)
        heading += radps * STEP_S
    return heading


@pytest.mark.parametrize("speed", [STANDING, None], ids=["speed known", "gyros alone"])
def test_turning_on_a_slope_swaps_its_parts(speed: tuple[float, float] | None) -> None:
    """A quarter turn to the left: uphill ahead becomes uphill right."""
    slope, tilt = started(0.25), math.sin(0.25)
    for i in range(200):
        turned = math.pi / 2 * (i + 0.5) / 200
        sines = tilt * math.cos(turned), -tilt * math.sin(turned)
        slope.update(STEP_S, (0.0, 0.0, math.pi / 20), (GRAVITY_MPS2 * sines[0], GRAVITY_MPS2 * sines[1]), speed)
        after = math.pi / 2 * (i + 1) / 200
        assert (slope.ahead, slope.left) == pytest.approx((tilt * math.cos(after), -tilt * math.sin(after)), abs=2e-3)
    assert angles(slope) == pytest.approx((0.0, -0.25), abs=2e-3)


def test_a_turn_tells_the_zero_of_the_accelerometer_from_a_slope() -> None:
    slope = SlopeFilter()
    heading = circle(slope, 200, zero=(0.006, -0.004), tilt=0.03)
    assert slope.ahead == pytest.approx(0.03 * math.cos(heading), abs=8e-4)
    assert slope.left == pytest.approx(-0.03 * math.sin(heading), abs=8e-4)
    assert slope.shown_ahead == pytest.approx(0.03 * math.cos(heading) + 0.006, abs=8e-4)


def test_an_acceleration_is_no_slope() -> None:
    """Sudden start and end: an acceleration 0.4 s late would seem 1 % of slope."""
    slope, speed, accel = started(), 0.0, -1.5
    for _ in range(200):
        slope.update(STEP_S, STRAIGHT, LEVEL, (speed, 0.0))
    for _ in range(40):
        speed += accel * STEP_S
        slope.update(STEP_S, STRAIGHT, (accel, 0.0), (speed, 0.0))
        assert slope.ahead == pytest.approx(0.0, abs=2e-4)


def bends(slope: SlopeFilter, slip: float, speed_mps: float, seconds: int) -> list[tuple[float, float]]:
    """Straights and alternating bends of 5 s on level ground; returns the estimated sines.

    slip: slip angle per lateral acceleration [rad s2/m]. The accelerometer feels the outward motion and its turn, the
    wheels do not.
    """
    shown, outwards_mps = [], 0.0
    for i in range(round(seconds / STEP_S)):
        radps = (0.0, 0.4, 0.0, -0.4)[int(i * STEP_S) // 5 % 4]
        before_mps, outwards_mps = outwards_mps, -slip * radps * speed_mps * abs(speed_mps)
        slope.update(
            STEP_S,
            (0.0, 0.0, radps),
            (-radps * outwards_mps, (outwards_mps - before_mps) / STEP_S),
            (speed_mps, 0.0),
        )
        shown.append((slope.ahead, slope.left))
    return shown


@pytest.mark.parametrize(("slip", "speed_mps"), [(0.01, -3.0), (0.03, 3.0)])
def test_tyres_that_slip_in_a_bend_are_no_slope(slip: float, speed_mps: float) -> None:
    """At 1.2 m/s2 a slip of 0.03 resembles 0.4 % of slope; without the state 0.3 % would remain."""
    slope = SlopeFilter()
    bends(slope, slip, speed_mps, 60)
    ahead, left = np.abs(bends(slope, slip, speed_mps, 60)).max(axis=0)
    assert ahead < 7e-4
    assert left < 1.2e-3


def test_wild_gyros_do_not_make_tyres_slip() -> None:
    """50 rad/s for a second at full speed."""
    slope = SlopeFilter()
    bends(slope, 0.01, 8.0, 60)
    for _ in range(20):
        slope.update(STEP_S, (0.0, 0.0, 50.0), LEVEL, (8.0, 0.0))
    assert np.abs(bends(slope, 0.01, 8.0, 100)[-400:]).max() < 2e-3


@pytest.mark.parametrize("jump_mps", [0.3, -2.5])
def test_wheels_that_slip_and_grip_again_are_no_slope(jump_mps: float) -> None:
    """Sand takes a tenth of wheel speed, locking all."""
    slope, worst = started(), 0.0
    for i in range(600):
        slips = 200 <= i < 240
        slope.update(STEP_S, STRAIGHT, LEVEL, (2.5 + slips * jump_mps, 0.0))
        worst = max(worst, abs(slope.ahead) if i >= 200 else 0.0)
    assert worst < 4e-3


def test_after_a_pause_the_slope_is_another_and_the_zero_is_not() -> None:
    slope = SlopeFilter()
    circle(slope, 200, zero=(0.006, 0.0), tilt=0.0)
    slope.restart()
    slope.update(STEP_S, STRAIGHT, (GRAVITY_MPS2 * 0.106, 0.0), (3.0, 0.0))
    assert slope.ahead == pytest.approx(0.1, abs=2e-3)
    for _ in range(20):
        slope.update(STEP_S, STRAIGHT, (GRAVITY_MPS2 * 0.106, 0.0), (3.0, 0.0))
    assert slope.ahead == pytest.approx(0.1, abs=2e-3)


@pytest.mark.parametrize("speed", [(0.0, 0.0), (1e3, -1e3), None])
def test_force_beyond_any_slope_is_survived(speed: Sequence[float] | None) -> None:
    slope = SlopeFilter()
    for _ in range(100):
        slope.update(0.01, (3.0, -3.0, 1.0), (400.0, -400.0), speed)
    assert all(-math.pi / 2 <= angle <= math.pi / 2 for angle in angles(slope))
    assert slope.variance > 0
