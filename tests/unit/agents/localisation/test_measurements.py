import math

import numpy as np
import pytest

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Filter, Measurement
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.motion import map_from_base
from agents.localisation.filters.state import ACCELERATION, ATTITUDE, POSITION, RATE, VELOCITY, YAW, Layout
from agents.localisation.filters.ukf import Ukf
from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2

PAPER, FULL = Layout(), Layout(imus=2, wheel_scale=True, receivers=2, references=1)
LEVER_M = np.array([0.8, -0.3, 3.0])


def every_kind(layout: Layout) -> list[Measurement]:
    """One measurement of each kind, none of the first sensor."""
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


@pytest.mark.parametrize("layout", [PAPER, FULL], ids=["paper", "full"])
@pytest.mark.parametrize("kind", range(9))
def test_jacobian_equals_finite_differences(kind: int, layout: Layout) -> None:
    measurement, x, step = every_kind(layout)[kind], somewhere(3, layout), 1e-6
    moved = step * np.eye(layout.n)
    differences = (measurement.h(x + moved) - measurement.h(x - moved)).T / (2 * step)
    jacobian = measurement.jacobian(x)
    assert jacobian.shape == (len(measurement.z), layout.n) == (len(measurement.R), layout.n)
    assert jacobian == pytest.approx(differences, abs=1e-6)


@pytest.mark.parametrize("layout", [PAPER, FULL], ids=["paper", "full"])
def test_many_states_are_predicted_as_each_alone(layout: Layout) -> None:
    states = np.stack([somewhere(seed, layout) for seed in range(4)])
    for measurement in every_kind(layout):
        alone = np.stack([predicted(measurement, x) for x in states])
        assert measurement.h(states) == pytest.approx(alone, abs=1e-12), measurement.sensor


def test_an_antenna_is_and_moves_as_the_body_carries_it() -> None:
    x = somewhere(2, PAPER)
    turn = map_from_base(x[ATTITUDE])
    fix = measurements.fix(0, "gps-1", np.zeros(2), np.eye(2), LEVER_M, None, 0.0)
    velocity = measurements.velocity(0, "gps-1", np.zeros(2), np.eye(2), LEVER_M, 0.0)
    assert predicted(fix, x) == pytest.approx((x[POSITION] + turn @ LEVER_M)[:2])
    assert predicted(velocity, x) == pytest.approx((turn @ (x[VELOCITY] + np.cross(x[RATE], LEVER_M)))[:2])


def imu(rates: Floats, force: Floats, lever_m: Floats | None = None, bias: int | None = None) -> Measurement:
    R = np.diag([1e-3**2] * 3 + [0.1**2] * 3)
    return measurements.inertial(
        0, "imu", np.concatenate([rates, force]), R, np.zeros(3) if lever_m is None else lever_m, bias, 0.0
    )


def test_specific_force_is_the_second_derivative_of_the_sensors_path() -> None:
    """Differences of a body point's position at constant body rate and acceleration."""
    x, lever, h = np.random.default_rng(1).normal(size=PAPER.n) * 0.5, np.array([1.0, -0.5, 2.0]), 1e-4

    def turned(t: float) -> Floats:
        """map_from_base after t, by the exponential series."""
        p, q, r = x[RATE] * t
        W = np.array([[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]])
        return map_from_base(x[ATTITUDE]) @ (np.eye(3) + W + W @ W / 2)

    def speed_of_point(t: float) -> Floats:
        return turned(t) @ (x[VELOCITY] + x[ACCELERATION] * t + np.cross(x[RATE], lever))

    acceleration = (speed_of_point(h) - speed_of_point(-h)) / (2 * h)
    force = map_from_base(x[ATTITUDE]).T @ (acceleration + np.array([0.0, 0.0, GRAVITY_MPS2]))
    assert predicted(imu(np.zeros(3), np.zeros(3), lever), x)[3:] == pytest.approx(force, abs=1e-6)


@pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])
def test_orientation_beyond_half_a_turn_is_near(engine: Filter) -> None:
    """3.1 rad believed, -3.1 rad measured: 0.08 rad apart, mean half a turn."""
    x = np.zeros(PAPER.n)
    x[YAW] = 3.1
    belief = Belief(0, x, np.eye(PAPER.n) * 1e-2)
    measured_rad = np.array([0.0, 0.0, -3.1])
    result = engine.condition(belief, measurements.orientation(0, "ahrs", measured_rad, np.eye(3) * 1e-2, 6.0))
    assert result.accepted
    assert result.innovation[2] == pytest.approx(2 * math.pi - 6.2)
    assert abs(math.remainder(result.belief.x[YAW] - math.pi, math.tau)) < 1e-9
