import math

import numpy as np
import pytest

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Filter, Measurement
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import map_from_base
from agents.localisation.filters.state import (
    ACCELERATION,
    ATTITUDE,
    PITCH,
    POSITION,
    RATE,
    ROLL,
    VELOCITY,
    YAW,
    YAW_RATE,
    Layout,
)
from agents.localisation.filters.ukf import Ukf
from protocol.arrays import Floats
from protocol.machine.machine_config import Mount
from protocol.units import GRAVITY_MPS2

PAPER, FULL = Layout(), Layout(imus=2, wheel_scale=True, receivers=2, references=1)
LEVER_M = np.array([0.8, -0.3, 3.0])


def every_kind(layout: Layout) -> list[Measurement]:
    """One measurement of each kind, of sensors that are not the first of theirs."""
    augmented = layout is FULL
    return [
        measurements.fix(0, "gps-2", np.zeros(2), np.eye(2), LEVER_M, layout.gps_error(1) if augmented else None, 4.0),
        measurements.inertial(
            0, "imu-2", np.zeros(6), np.eye(6), LEVER_M, layout.gyro_bias(1) if augmented else None, 6.0
        ),
        measurements.wheels(0, "wheels", np.zeros(3), np.eye(3), layout.wheel_scales.start if augmented else None, 6.0),
        measurements.orientation(0, "ahrs", np.zeros(3), np.eye(3), 6.0),
        measurements.standstill(0),
        measurements.velocity(0, "gps-2", np.zeros(2), np.eye(2), LEVER_M, 4.0),
        measurements.rotation(0, "ahrs", np.zeros(3), np.eye(3), 6.0),
        measurements.turn(0, "turn", 0.0, 0.02, layout.gyro_bias(1) if augmented else None, 3.0, 6.0),
        measurements.orientation(
            0, "ahrs", np.zeros(3), np.eye(3), 6.0, layout.heading_errors.start if augmented else None
        ),
    ]


def somewhere(seed: int, layout: Layout) -> Floats:
    return np.random.default_rng(seed).normal(size=layout.n)


def predicted(measurement: Measurement, x: Floats) -> Floats:
    return measurement.h(x[None])[0]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("layout", [PAPER, FULL], ids=["paper", "full"])
@pytest.mark.parametrize("kind", range(9))
def test_jacobian_equals_finite_differences(kind: int, layout: Layout, seed: int) -> None:
    measurement, x, step = every_kind(layout)[kind], somewhere(seed, layout), 1e-6
    moved = step * np.eye(layout.n)
    differences = (measurement.h(x + moved) - measurement.h(x - moved)).T / (2 * step)
    jacobian = measurement.jacobian(x)
    assert jacobian.shape == (len(measurement.z), layout.n) == (len(measurement.R), layout.n)
    assert jacobian == pytest.approx(differences, abs=1e-6), f"seed={seed}"


@pytest.mark.parametrize("layout", [PAPER, FULL], ids=["paper", "full"])
def test_many_states_are_predicted_as_each_alone(layout: Layout) -> None:
    states = np.stack([somewhere(seed, layout) for seed in range(4)])
    for measurement in every_kind(layout):
        alone = np.stack([predicted(measurement, x) for x in states])
        assert measurement.h(states) == pytest.approx(alone, abs=1e-12), measurement.sensor


# --- GPS -------------------------------------------------------------------------------------------------------------


def fix_at(attitude: tuple[float, float, float], lever_m: tuple[float, float, float]) -> list[float]:
    x = np.zeros(PAPER.n)
    x[POSITION], x[ATTITUDE] = (10.0, 20.0, 5.0), attitude
    measurement = measurements.fix(0, "gps-1", np.zeros(2), np.eye(2), np.array(lever_m), None, 0.0)
    return list(predicted(measurement, x))


@pytest.mark.parametrize("seed", range(5))
def test_antenna_is_where_the_rotation_of_the_attitude_puts_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    attitude, lever = rng.uniform(-1.4, 1.4, 3), rng.normal(size=3)
    expected = np.array([10.0, 20.0, 5.0]) + map_from_base(attitude) @ lever
    assert fix_at(tuple(attitude), tuple(lever)) == pytest.approx(expected[:2]), f"seed={seed}"


@pytest.mark.parametrize("seed", range(5))
def test_velocity_of_an_antenna_is_that_of_the_body_and_of_its_turn(seed: int) -> None:
    x = somewhere(seed, PAPER)
    expected = map_from_base(x[ATTITUDE]) @ (x[VELOCITY] + np.cross(x[RATE], LEVER_M))
    measurement = measurements.velocity(0, "gps-1", np.zeros(2), np.eye(2), LEVER_M, 0.0)
    assert predicted(measurement, x) == pytest.approx(expected[:2]), f"seed={seed}"


def test_a_receivers_own_error_is_added_to_its_fix_and_to_no_other() -> None:
    x = np.zeros(FULL.n)
    x[FULL.gps_error(0)], x[FULL.gps_error(1)] = (100.0, 200.0), (3.0, 4.0)
    fix = measurements.fix(0, "gps-2", np.zeros(2), np.eye(2), np.zeros(3), FULL.gps_error(1), 0.0)
    assert predicted(fix, x).tolist() == [3.0, 4.0]


# --- IMU -------------------------------------------------------------------------------------------------------------


def imu(rates: Floats, force: Floats, lever_m: Floats | None = None, bias: int | None = None) -> Measurement:
    R = np.diag([1e-3**2] * 3 + [0.1**2] * 3)
    return measurements.inertial(
        0, "imu", np.concatenate([rates, force]), R, np.zeros(3) if lever_m is None else lever_m, bias, 0.0
    )


@pytest.mark.parametrize("rpy_deg", [(0.0, 0.0, 0.0), (180.0, 0.0, 90.0), (20.0, -35.0, 110.0)])
def test_gravity_is_removed_on_a_slope_at_any_mounting(rpy_deg: tuple[float, float, float]) -> None:
    """Made from rotation matrices alone: what the sensor measures in its own axes at rest, turned into `base_link`."""
    mount, x = Mount((0.4, 0.0, 0.9), rpy_deg), np.zeros(PAPER.n)
    x[ATTITUDE] = (0.15, -0.25, 2.0)
    map_from_sensor = map_from_base(x[ATTITUDE]) @ mount.frame_from_sensor()
    force = map_from_sensor.T @ (0.0, 0.0, GRAVITY_MPS2)  # raw, in the sensor
    measurement = imu(np.zeros(3), mount.frame_from_sensor() @ force, np.array(mount.xyz_m))
    assert predicted(measurement, x) == pytest.approx(measurement.z, abs=1e-12)


@pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])
def test_an_imu_at_rest_on_a_slope_shows_roll_and_pitch_and_no_acceleration(engine: Filter) -> None:
    roll, pitch = 0.1, -0.2
    force = map_from_base(np.array([roll, pitch, 0.7])).T @ (0.0, 0.0, GRAVITY_MPS2)
    variances = np.full(PAPER.n, 1e-6)
    variances[ATTITUDE] = 0.3**2
    belief = Belief(0, np.zeros(PAPER.n), np.diag(variances))
    for _ in range(4):
        belief = engine.condition(belief, imu(np.zeros(3), force)).belief
    assert belief.x[[ROLL, PITCH]] == pytest.approx([roll, pitch], abs=0.01)
    assert belief.x[YAW] == pytest.approx(0.0, abs=1e-6)
    assert belief.x[ACCELERATION] == pytest.approx(np.zeros(3), abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_specific_force_is_the_second_derivative_of_the_sensors_path(seed: int) -> None:
    """Differences of the position of a point that moves with the body, at constant body rate and acceleration."""
    x, lever, h = np.random.default_rng(seed).normal(size=PAPER.n) * 0.5, np.array([1.0, -0.5, 2.0]), 1e-4

    def turned(t: float) -> Floats:
        """map_from_base after t, by the exponential series."""
        p, q, r = x[RATE] * t
        W = np.array([[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]])
        return map_from_base(x[ATTITUDE]) @ (np.eye(3) + W + W @ W / 2)

    def speed_of_point(t: float) -> Floats:
        return turned(t) @ (x[VELOCITY] + x[ACCELERATION] * t + np.cross(x[RATE], lever))

    acceleration = (speed_of_point(h) - speed_of_point(-h)) / (2 * h)
    force = map_from_base(x[ATTITUDE]).T @ (acceleration + np.array([0.0, 0.0, GRAVITY_MPS2]))
    assert predicted(imu(np.zeros(3), np.zeros(3), lever), x)[3:] == pytest.approx(force, abs=1e-6), f"seed={seed}"


def test_a_gyro_measures_the_rates_and_its_own_bias_about_the_vertical() -> None:
    x = np.zeros(FULL.n)
    x[RATE], x[FULL.gyro_bias(0)], x[FULL.gyro_bias(1)] = (0.1, 0.2, 0.3), 9.0, 0.01
    rates = predicted(imu(np.zeros(3), np.zeros(3), bias=FULL.gyro_bias(1)), x)[:3]
    assert rates == pytest.approx([0.1, 0.2, 0.31])


# --- wheels, orientation, standstill ---------------------------------------------------------------------------------


def test_wheels_turn_by_their_scale_more_ahead_and_not_sideways() -> None:
    x = np.zeros(FULL.n)
    x[VELOCITY], x[FULL.wheel_scales] = (2.0, 0.3, 0.1), 0.05
    scaled = measurements.wheels(0, "wheels", np.zeros(3), np.eye(3), FULL.wheel_scales.start, 0.0)
    assert predicted(scaled, x) == pytest.approx([2.1, 0.3, 0.1])
    unscaled = measurements.wheels(0, "wheels", np.zeros(3), np.eye(3), None, 0.0)
    assert predicted(unscaled, x) == pytest.approx([2.0, 0.3, 0.1])


@pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])
def test_orientation_beyond_half_a_turn_is_near(engine: Filter) -> None:
    """Believed 3.1 rad, measured -3.1 rad: they are 0.08 rad apart, and the mean is half a turn."""
    x = np.zeros(PAPER.n)
    x[YAW] = 3.1
    belief = Belief(0, x, np.eye(PAPER.n) * 1e-2)
    measured_rad = np.array([0.0, 0.0, -3.1])
    result = engine.condition(belief, measurements.orientation(0, "ahrs", measured_rad, np.eye(3) * 1e-2, 6.0))
    assert result.accepted
    assert result.innovation[2] == pytest.approx(2 * math.pi - 6.2)
    assert abs(math.remainder(result.belief.x[YAW] - math.pi, math.tau)) < 1e-9


@pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])
def test_standstill_stops_the_machine_and_turns_the_gyros_rate_into_bias(engine: Filter) -> None:
    x, variances = np.zeros(FULL.n), np.full(FULL.n, 1e-6)
    x[VELOCITY], x[YAW_RATE] = (0.1, -0.05, 0.02), 0.01
    variances[VELOCITY], variances[RATE], variances[FULL.gyro_biases] = 0.1**2, 0.1**2, 0.01**2
    belief = Belief(0, x, np.diag(variances))
    gyro = imu(np.array([0.0, 0.0, 0.01]), np.array([0.0, 0.0, GRAVITY_MPS2]), bias=FULL.gyro_bias(0))
    for measurement in (gyro, measurements.standstill(0)):
        result = engine.condition(belief, measurement)
        assert result.accepted
        belief = result.belief
    assert np.abs(belief.x[VELOCITY]).max() < 2e-3
    assert np.abs(belief.x[RATE]).max() < 1e-4
    assert belief.x[FULL.gyro_bias(0)] == pytest.approx(0.01, abs=3e-4)


def test_a_machine_that_surely_turns_does_not_stand_still() -> None:
    x = np.zeros(PAPER.n)
    x[YAW_RATE] = 0.1
    belief = Belief(0, x, np.eye(PAPER.n) * 1e-4)
    assumed = measurements.standstill(0)
    assert not Ekf().condition(belief, assumed).accepted
    assert not assumed.relocks
