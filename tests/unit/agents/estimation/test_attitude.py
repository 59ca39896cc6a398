import math

import numpy as np
import pytest

from agents.estimation import attitude
from agents.estimation.attitude import BIAS_STD_RADPS, FORCE_STD_MPS2, RATE_WALK, SlopeFilter
from protocol.units import GRAVITY_MPS2


@pytest.fixture
def gyros_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The accelerometer counts for nothing, and biases are zero."""
    for name, value in (("FORCE_STD_MPS2", 1e6), ("BIAS_STD_RADPS", 1e-9), ("BIAS_WALK", 1e-9)):
        monkeypatch.setattr(attitude, name, value)


def standing(ahead_rad: float, left_rad: float) -> SlopeFilter:
    slope = SlopeFilter()
    slope.update(0.01, (0.0, 0.0, 0.0), force(ahead_rad, left_rad))
    return slope


def force(ahead_rad: float, left_rad: float) -> tuple[float, float]:
    return GRAVITY_MPS2 * math.sin(ahead_rad), GRAVITY_MPS2 * math.sin(left_rad)


def angles(slope: SlopeFilter) -> tuple[float, float]:
    return slope.ahead.angle_rad, slope.left.angle_rad


def test_first_reading_is_believed() -> None:
    assert angles(standing(0.2, -0.1)) == pytest.approx((0.2, -0.1))


def turn_on_a_slope() -> None:
    """A quarter turn to the left: what rose ahead now rises to the right."""
    slope = standing(0.25, 0.0)
    for i in range(1, 1001):
        turned = math.pi / 2 * i / 1000
        sines = math.sin(0.25) * math.cos(turned), -math.sin(0.25) * math.sin(turned)
        slope.update(0.01, (0.0, 0.0, math.pi / 20), (GRAVITY_MPS2 * sines[0], GRAVITY_MPS2 * sines[1]))
        assert (slope.ahead.sine, slope.left.sine) == pytest.approx(sines, abs=2e-3)
    assert angles(slope) == pytest.approx((0.0, -0.25), abs=2e-3)


def test_turning_on_a_slope_swaps_its_parts() -> None:
    turn_on_a_slope()


@pytest.mark.usefixtures("gyros_alone")
def test_turning_on_a_slope_swaps_its_parts_by_gyros_alone() -> None:
    turn_on_a_slope()


@pytest.mark.usefixtures("gyros_alone")
@pytest.mark.parametrize(
    ("rates", "expected"), [((0.0, -0.1, 0.0), (0.3, 0.0)), ((0.1, 0.0, 0.0), (0.0, 0.3))], ids=["nose up", "left up"]
)
def test_gyros_carry_the_slope_through_a_change(
    rates: tuple[float, float, float], expected: tuple[float, float]
) -> None:
    """3 s at 0.1 rad/s; the nose rises by a negative turn about y, the left side by a positive one about x."""
    slope = standing(0.0, 0.0)
    for _ in range(300):
        slope.update(0.01, rates, (0.0, 0.0))
    assert angles(slope) == pytest.approx(expected, abs=2e-3)


def test_both_gyro_biases_are_estimated() -> None:
    slope = SlopeFilter()
    for _ in range(30_000):
        slope.update(0.02, (0.0015, 0.002, 0.0), force(0.2, -0.1))
    assert angles(slope) == pytest.approx((0.2, -0.1), abs=1e-3)
    assert slope.ahead._bias == pytest.approx(-0.002, abs=3e-4)  # of the sines' rates
    assert slope.left._bias == pytest.approx(0.0015, abs=3e-4)


@pytest.mark.parametrize("dt", [0.01, 0.03])
def test_variance_is_honest_whatever_the_rate(dt: float) -> None:
    """Vibration is white noise: as readings come less often, each averages over more of it."""
    seed = 3
    rng = np.random.default_rng(seed)
    slope, errors = SlopeFilter(), []
    noise = FORCE_STD_MPS2 * math.sqrt(0.02 / dt)
    for i in range(20_000):
        measured = force(0.1, 0.0)[0] + noise * rng.standard_normal()
        slope.update(dt, (0.0, 0.0, 0.0), (measured, 0.0))
        if i > 2000:
            errors.append(slope.ahead.angle_rad - 0.1)
    assert np.mean(np.square(errors)) < 2 * slope.ahead.variance, f"{seed=}"
    assert 0 < slope.ahead.variance < 0.05**2


def test_normalised_error_is_one_where_the_slope_wanders_as_assumed() -> None:
    seed, dt = 5, 0.01
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(40):
        slope, angle, bias = SlopeFilter(), 0.05, BIAS_STD_RADPS * rng.standard_normal()
        for _ in range(1000):
            angle += RATE_WALK * math.sqrt(dt) * rng.standard_normal()  # which the gyro does not measure
            measured = GRAVITY_MPS2 * math.sin(angle) + FORCE_STD_MPS2 * math.sqrt(2) * rng.standard_normal()
            slope.update(dt, (0.0, bias, 0.0), (measured, 0.0))
        errors.append((slope.ahead.angle_rad - angle) / math.sqrt(slope.ahead.variance))
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.6 < rms < 1.5, f"{seed=} {rms=}"


@pytest.mark.parametrize("dt", [0.01, 0.04])
def test_first_correction_by_hand(dt: float) -> None:
    """Variance 0.05^2 at first; noise of 0.35 m/s2 over 20 ms, less over longer ones."""
    slope = standing(0.0, 0.0)
    slope.update(dt, (0.0, 0.0, 0.0), (0.5, 0.0))
    before = 0.05**2 + (2e-3 * dt) ** 2 + 1.5e-3**2 * dt
    noise = (0.35 / GRAVITY_MPS2) ** 2 * 0.02 / dt
    assert slope.ahead.sine == pytest.approx(before / (before + noise) * 0.5 / GRAVITY_MPS2)
    assert slope.ahead.variance == pytest.approx(before * noise / (before + noise))


def test_force_beyond_any_slope_is_survived() -> None:
    slope = SlopeFilter()
    for _ in range(100):
        slope.update(0.01, (3.0, -3.0, 1.0), (400.0, -400.0))
    assert all(math.isfinite(angle) for angle in angles(slope))
