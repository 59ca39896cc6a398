import math
from typing import Any

import numpy as np
import pytest
from agents_drives import Drive, Ground, Leg, drive, machine

from agents.estimation.attitude import AttitudeConfig, SlopeFilter
from agents.estimation.ground import UNKNOWN, EstimationConfig, GroundEstimate, GroundEstimator
from agents.physics import GRAVITY_MPS2
from protocol.machine import MachineConfig, Mount
from protocol.readings import Imu, Torque

SLOPE_RAD = math.radians(15)
FORWARDS = [Leg(4, 0.5), Leg(8)]
REVERSE = [Leg(4, -0.5), Leg(8)]


def estimate(of: MachineConfig, made: Drive, **options: Any) -> GroundEstimate:
    return track(of, made, **options)[-1]


def track(of: MachineConfig, made: Drive, **options: Any) -> list[GroundEstimate]:
    """The estimate after every IMU reading; speed and acceleration are the true ones."""
    estimator = GroundEstimator(of, EstimationConfig(**options))
    accel = np.diff(made.speed_mps, prepend=0.0) / 0.01
    step = {stamp: i for i, stamp in enumerate(made.stamps_ns)}
    found = []
    for reading in made.readings:
        sensor = of.sensor(reading.sensor)
        assert sensor
        i = step[reading.stamp_ns]
        estimator.update(reading, sensor, float(made.speed_mps[i]), float(accel[i]))
        if isinstance(reading, Imu):
            found.append(estimator.now(float(made.speed_mps[i])))
    return found


@pytest.mark.parametrize("legs", [FORWARDS, REVERSE], ids=["forwards", "reverse"])
@pytest.mark.parametrize("c_rr", [0.008, 0.06, 0.25])
@pytest.mark.parametrize("ahead_rad", [0.0, SLOPE_RAD, -SLOPE_RAD])
def test_resistance_and_slope_are_right(legs: list[Leg], c_rr: float, ahead_rad: float) -> None:
    """Positive slope is uphill ahead, also when the machine drives down it backwards."""
    of = machine()
    found = estimate(of, drive(legs, of, ground=Ground(c_rr, ahead_rad)))
    assert found.c_rr == pytest.approx(c_rr, abs=0.002)
    assert found.slope_x == pytest.approx(math.tan(ahead_rad), abs=0.004)
    assert found.slope_y == pytest.approx(0.0, abs=0.002)
    assert abs(found.pitch_rate_radps) < 1e-6


@pytest.mark.parametrize("turn_radps", [0.0, 0.2])
def test_slope_across_the_driving_direction(turn_radps: float) -> None:
    """The centripetal acceleration of a bend is no slope."""
    of = machine()
    ground = Ground(0.04, left_rad=SLOPE_RAD)
    found = estimate(of, drive([Leg(4, 0.5), Leg(8, 0.0, turn_radps)], of, ground=ground))
    assert found.slope_y == pytest.approx(math.tan(SLOPE_RAD), abs=0.01)
    assert found.slope_x == pytest.approx(0.0, abs=0.005)


def test_accelerating_does_not_change_the_resistance() -> None:
    of = machine()
    legs = [Leg(4, 0.5), Leg(2), Leg(2, 0.6), Leg(2, -0.6), Leg(2, 0.6)]
    found = track(of, drive(legs, of, ground=Ground(0.05)))[500:]
    assert np.abs([e.c_rr - 0.05 for e in found]).max() < 0.003


def test_rotating_mass_counts() -> None:
    of, wrong = machine(rotating_mass_factor=1.2), machine(rotating_mass_factor=1.0)
    made = drive([Leg(10, 0.5)], of)
    assert estimate(of, made).c_rr == pytest.approx(0.04, abs=0.002)
    assert estimate(wrong, made).c_rr == pytest.approx(0.04 + 0.2 * 0.5 / GRAVITY_MPS2, abs=0.002)


def test_border_between_two_grounds_is_found_within_three_metres() -> None:
    of = machine()
    a, b = (drive(FORWARDS, of, ground=Ground(c)) for c in (0.02, 0.25))
    border_ns = a.stamps_ns[800]
    readings = [r if r.stamp_ns < border_ns else s for r, s in zip(a.readings, b.readings, strict=True)]
    both = Drive(a.stamps_ns, a.x_m, a.y_m, a.heading_rad, a.speed_mps, readings)
    found = track(of, both)
    assert found[799].c_rr == pytest.approx(0.02, abs=0.002)
    assert found[799 + 150].c_rr == pytest.approx(0.25, abs=0.02)  # 1.5 s at 2 m/s
    slow = track(of, both, jump=10.0)
    assert abs(slow[799 + 150].c_rr - 0.25) > abs(found[799 + 150].c_rr - 0.25)


def test_nothing_is_known_before_the_imu_speaks() -> None:
    assert GroundEstimator(machine(), EstimationConfig()).now(2.0) == UNKNOWN


def test_without_torque_there_is_a_slope_but_no_resistance() -> None:
    of = machine()
    found = estimate(of, drive(FORWARDS, of, ground=Ground(0.04, SLOPE_RAD), without=("torque",)))
    assert math.isnan(found.c_rr)
    assert math.isnan(found.c_rr_var)
    assert found.slope_x == pytest.approx(math.tan(SLOPE_RAD), abs=0.004)


def test_stale_torque_is_missing_torque() -> None:
    of = machine()
    made = drive(FORWARDS, of)
    silent_ns = made.stamps_ns[800]
    readings = [r for r in made.readings if not isinstance(r, Torque) or r.stamp_ns <= silent_ns]
    found = track(of, Drive(made.stamps_ns, made.x_m, made.y_m, made.heading_rad, made.speed_mps, readings))
    assert math.isfinite(found[800 + 45].c_rr)
    assert math.isnan(found[800 + 55].c_rr)


def test_standing_machine_learns_nothing() -> None:
    of = machine()
    found = track(of, drive([*FORWARDS, Leg(4, -0.5), Leg(5)], of, ground=Ground(0.2)))
    assert math.isnan(found[-1].c_rr)
    assert found[-1].slope_x == pytest.approx(0.0, abs=0.005)
    again = track(of, drive([*FORWARDS, Leg(4, -0.5), Leg(5), Leg(1, 0.6)], of, ground=Ground(0.2)))
    assert again[-1].c_rr == pytest.approx(0.2, abs=0.005)  # what was learnt before the stop is still there


def test_variance_grows_with_the_drive_force() -> None:
    of = machine()
    flat, steep = (estimate(of, drive(FORWARDS, of, ground=Ground(0.02, a))) for a in (0.0, SLOPE_RAD))
    assert steep.c_rr_var > 3 * flat.c_rr_var
    expected = (0.05 * (math.sin(SLOPE_RAD) + 0.02 * math.cos(SLOPE_RAD))) ** 2
    assert steep.c_rr_var - flat.c_rr_var == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("rpy_deg", [(0.0, 0.0, 90.0), (180.0, 0.0, 0.0), (90.0, 0.0, -90.0), (10.0, -20.0, 30.0)])
def test_mounting_is_turned_back(rpy_deg: tuple[float, float, float]) -> None:
    of = machine(Mount((0.4, 0.0, 0.9), rpy_deg))
    found = estimate(of, drive(FORWARDS, of, ground=Ground(0.05, SLOPE_RAD, 0.1)))
    assert found.c_rr == pytest.approx(0.05, abs=0.002)
    assert (found.slope_x, found.slope_y) == pytest.approx((math.tan(SLOPE_RAD), math.tan(0.1)), abs=0.005)


def test_nose_that_rises_is_a_positive_pitch_rate() -> None:
    of = machine()
    made = drive(FORWARDS, of)
    sensor = of.sensor("imu")
    assert sensor
    estimator = GroundEstimator(of, EstimationConfig())
    for i, stamp in enumerate(made.stamps_ns[:300]):
        angle = 0.1 * i * 0.01
        force = (GRAVITY_MPS2 * math.sin(angle), 0.0, GRAVITY_MPS2 * math.cos(angle))
        estimator.update(Imu("imu", stamp, 0.0, -0.1, 0.0, *force), sensor, 0.0, 0.0)
    assert estimator.now(0.0).pitch_rate_radps == pytest.approx(0.1, abs=1e-3)
    assert estimator.now(0.0).slope_x == pytest.approx(math.tan(0.3), abs=0.005)


def test_slope_filter_finds_the_gyro_bias() -> None:
    config = AttitudeConfig()
    slope = SlopeFilter(config)
    for _ in range(60_000):
        slope.update(0.01, 0.002, GRAVITY_MPS2 * math.sin(0.2))
    assert slope.angle_rad == pytest.approx(0.2, abs=1e-3)
    assert 0 < slope.variance_rad2 < 0.05**2


def test_slope_filter_s_variance_is_honest_whatever_the_rate() -> None:
    seed = 3
    rng = np.random.default_rng(seed)
    for dt in (0.01, 0.03):
        slope, config, errors = SlopeFilter(AttitudeConfig()), AttitudeConfig(), []
        noise = config.force_std_mps2 * math.sqrt(0.01 / dt)
        for i in range(20_000):
            slope.update(dt, 0.0, GRAVITY_MPS2 * math.sin(0.1) + noise * rng.standard_normal())
            if i > 2000:
                errors.append(slope.angle_rad - 0.1)
        assert np.mean(np.square(errors)) < 2 * slope.variance_rad2, f"seed={seed} dt={dt}"


@pytest.mark.parametrize("name", sorted(set(EstimationConfig.__dataclass_fields__) - {"attitude"}))
def test_bad_estimation_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        EstimationConfig(**{name: 0.0})


@pytest.mark.parametrize("name", list(AttitudeConfig.__dataclass_fields__))
def test_bad_attitude_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        AttitudeConfig(**{name: -1.0})
