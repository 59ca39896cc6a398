import math
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.attitude import AttitudeConfig, LeanFilter
from protocol.units import GRAVITY_MPS2

# Only gyros: the accelerometer is not believed, biases are not looked for.
GYROS_ALONE = AttitudeConfig(force_std_mps2=1e6, bias_std_radps=1e-9, bias_walk=1e-9)


def standing(ahead_rad: float, left_rad: float, config: AttitudeConfig | None = None) -> LeanFilter:
    lean = LeanFilter(config or AttitudeConfig())
    lean.update(0.01, (0.0, 0.0, 0.0), force(ahead_rad, left_rad))
    return lean


def force(ahead_rad: float, left_rad: float) -> tuple[float, float]:
    return GRAVITY_MPS2 * math.sin(ahead_rad), GRAVITY_MPS2 * math.sin(left_rad)


def angles(lean: LeanFilter) -> tuple[float, float]:
    return lean.ahead.angle_rad, lean.left.angle_rad


def test_first_reading_is_believed() -> None:
    assert angles(standing(0.2, -0.1)) == pytest.approx((0.2, -0.1))


@pytest.mark.parametrize("config", [GYROS_ALONE, AttitudeConfig()], ids=["gyros alone", "default"])
def test_turning_on_a_slope_swaps_its_parts(config: AttitudeConfig) -> None:
    """A quarter turn to the left: what rose ahead now rises to the right."""
    lean = standing(0.25, 0.0, config)
    for i in range(1, 1001):
        turned = math.pi / 2 * i / 1000
        sines = math.sin(0.25) * math.cos(turned), -math.sin(0.25) * math.sin(turned)
        lean.update(0.01, (0.0, 0.0, math.pi / 20), (GRAVITY_MPS2 * sines[0], GRAVITY_MPS2 * sines[1]))
        assert (lean.ahead.sine, lean.left.sine) == pytest.approx(sines, abs=2e-3)
    assert angles(lean) == pytest.approx((0.0, -0.25), abs=2e-3)


@pytest.mark.parametrize(
    ("rates", "expected"), [((0.0, -0.1, 0.0), (0.3, 0.0)), ((0.1, 0.0, 0.0), (0.0, 0.3))], ids=["nose up", "left up"]
)
def test_gyros_carry_the_slope_through_a_change(
    rates: tuple[float, float, float], expected: tuple[float, float]
) -> None:
    """3 s at 0.1 rad/s; the nose rises by a negative turn about y, the left side by a positive one about x."""
    lean = standing(0.0, 0.0, GYROS_ALONE)
    for _ in range(300):
        lean.update(0.01, rates, (0.0, 0.0))
    assert angles(lean) == pytest.approx(expected, abs=2e-3)


def test_both_gyro_biases_are_found() -> None:
    lean = LeanFilter(AttitudeConfig())
    for _ in range(60_000):
        lean.update(0.01, (0.0015, 0.002, 0.0), force(0.2, -0.1))
    assert angles(lean) == pytest.approx((0.2, -0.1), abs=1e-3)
    assert lean.ahead._bias == pytest.approx(-0.002, abs=3e-4)  # of the sines' rates
    assert lean.left._bias == pytest.approx(0.0015, abs=3e-4)


@pytest.mark.parametrize("dt", [0.01, 0.03])
def test_variance_is_honest_whatever_the_rate(dt: float) -> None:
    """Vibration is white noise: as readings come less often, each averages over more of it."""
    seed, config = 3, AttitudeConfig()
    rng = np.random.default_rng(seed)
    lean, errors = LeanFilter(config), []
    noise = config.force_std_mps2 * math.sqrt(0.02 / dt)
    for i in range(20_000):
        felt = force(0.1, 0.0)[0] + noise * rng.standard_normal()
        lean.update(dt, (0.0, 0.0, 0.0), (felt, 0.0))
        if i > 2000:
            errors.append(lean.ahead.angle_rad - 0.1)
    assert np.mean(np.square(errors)) < 2 * lean.ahead.variance, f"{seed=}"
    assert 0 < lean.ahead.variance < 0.05**2


def test_normalised_error_is_one_where_the_slope_wanders_as_assumed() -> None:
    seed, config, dt = 5, AttitudeConfig(), 0.01
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(40):
        lean, angle, bias = LeanFilter(config), 0.05, config.bias_std_radps * rng.standard_normal()
        for _ in range(1500):
            step = config.rate_walk * math.sqrt(dt) * rng.standard_normal()  # of which the gyro knows nothing
            angle += step
            felt = GRAVITY_MPS2 * math.sin(angle) + config.force_std_mps2 * math.sqrt(2) * rng.standard_normal()
            lean.update(dt, (0.0, bias, 0.0), (felt, 0.0))
        found.append((lean.ahead.angle_rad - angle) / math.sqrt(lean.ahead.variance))
    rms = float(np.sqrt(np.mean(np.square(found))))
    assert 0.6 < rms < 1.5, f"{seed=} {rms=}"


@pytest.mark.parametrize("dt", [0.01, 0.04])
def test_first_correction_by_hand(dt: float) -> None:
    """Variance 0.05^2 at first; noise of 0.35 m/s2 over 20 ms, less over longer ones."""
    lean = standing(0.0, 0.0)
    lean.update(dt, (0.0, 0.0, 0.0), (0.5, 0.0))
    before = 0.05**2 + (2e-3 * dt) ** 2 + 1.5e-3**2 * dt
    noise = (0.35 / GRAVITY_MPS2) ** 2 * 0.02 / dt
    assert lean.ahead.sine == pytest.approx(before / (before + noise) * 0.5 / GRAVITY_MPS2)
    assert lean.ahead.variance == pytest.approx(before * noise / (before + noise))


def test_force_beyond_any_slope_is_survived() -> None:
    lean = LeanFilter(AttitudeConfig())
    for _ in range(100):
        lean.update(0.01, (3.0, -3.0, 1.0), (400.0, -400.0))
    assert all(math.isfinite(angle) for angle in angles(lean))


@pytest.mark.parametrize("name", list(AttitudeConfig.__dataclass_fields__))
def test_option_changes_the_slope(name: str) -> None:
    found = []
    for config in (AttitudeConfig(), replace(AttitudeConfig(), **{name: 3 * getattr(AttitudeConfig(), name)})):
        lean = standing(0.0, 0.0, config)
        for i in range(500):
            lean.update(0.01, (0.0, 0.001, 0.0), force(0.02 * math.sin(0.1 * i), 0.0))
        found.append(lean.ahead.angle_rad)
    assert found[0] != found[1]


@pytest.mark.parametrize("name", list(AttitudeConfig.__dataclass_fields__))
def test_bad_attitude_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        AttitudeConfig(**{name: -1.0})
