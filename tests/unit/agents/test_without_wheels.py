"""Machines with no or silent wheels: GPS speed over ground instead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckoning
from agents.ground_speed import GroundTracker
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline, PipelineConfig, Positioning
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Imu, Odometry, Reading
from tests.unit.agents.drives import LEVER_M, SITE, START_NS, VEHICLE, Drive, Ground, Leg, drive

EKF = PipelineConfig(LocalisationConfig("ekf"))
DOPPLER = SensorConfig("doppler", "gps_velocity", Mount(LEVER_M))
S_BENDS = (Leg(3), Leg(4, 0.6), Leg(12, 0, 0.1), Leg(12, 0, -0.1), Leg(4, -0.6), Leg(6), Leg(4, 0.6), Leg(20, 0, 0.08))
REVERSES_FIRST = (Leg(3), Leg(3, -0.6), Leg(8, 0, 0.1), Leg(3, 0.6), Leg(2), Leg(4, 0.6), Leg(25, 0, 0.1))
FIX_STD_M, DOPPLER_STD_MPS = 0.5, 0.1


def equipped(*kinds: str) -> MachineConfig:
    """The machine with these sensor kinds only."""
    return replace(VEHICLE, sensors=tuple(s for s in (*VEHICLE.sensors, DOPPLER) if s.kind in kinds))


def sensed(made: Drive, vehicle: MachineConfig, seed: int = 1) -> list[Reading]:
    """Noisy, biased readings: Doppler 2 Hz, IMU 50 Hz."""
    rng, sees = np.random.default_rng(seed), {s.kind for s in vehicle.sensors}
    readings: list[Reading] = doppler(made, rng) if DOPPLER.kind in sees else []
    for i, reading in enumerate(r for r in made.readings if r.kind in sees):
        if isinstance(reading, Gps):
            east, north = rng.normal(0, FIX_STD_M, 2) / 111_200
            place = reading.lat_deg + north, reading.lon_deg + east / math.cos(math.radians(SITE.origin_lat_deg))
            variance = FIX_STD_M**2
            readings.append(replace(reading, lat_deg=place[0], lon_deg=place[1], var_e_m2=variance, var_n_m2=variance))
        elif isinstance(reading, Imu):
            w, f = rng.normal((0, 0, 0.003), 0.004), rng.normal((0.03, 0, 0), 0.2)
            if i % 2:
                readings.append(
                    replace(
                        reading,
                        **{f"gyro_{a}_radps": getattr(reading, f"gyro_{a}_radps") + w[j] for j, a in enumerate("xyz")},
                        **{f"force_{a}_mps2": getattr(reading, f"force_{a}_mps2") + f[j] for j, a in enumerate("xyz")},
                    )
                )
        else:
            readings.append(reading)
    return sorted(readings, key=lambda r: r.stamp_ns)


def doppler(made: Drive, rng: np.random.Generator) -> list[Reading]:
    ahead, left, _ = LEVER_M
    c, s = np.cos(made.heading_rad), np.sin(made.heading_rad)
    east, north = (np.gradient(a, 0.01) for a in (made.x_m + c * ahead - s * left, made.y_m + s * ahead + c * left))
    variance = DOPPLER_STD_MPS**2
    return [
        GpsVelocity(
            "doppler", made.stamps_ns[i], *(rng.normal((east[i], north[i]), DOPPLER_STD_MPS)), variance, variance
        )
        for i in range(50, len(made.stamps_ns) - 1, 50)
    ]


@dataclass(frozen=True)
class Errors:
    """Poses at 10 Hz: stamps [s], distance [m], heading [rad], inside the 95 % ellipse."""

    seconds: Floats
    off_m: Floats
    heading_rad: Floats
    holds: Floats


def located(made: Drive, vehicle: MachineConfig, readings: Sequence[Reading]) -> tuple[Errors, Positioning]:
    core, rows = Positioning(SITE, vehicle, EKF), []
    for reading in readings:
        core.step([reading])
        if (pose := core.pose) and (not rows or pose.stamp_ns - rows[-1][0] > 100_000_000):
            x, y, heading = made.at(pose.stamp_ns)
            off = np.array([pose.x_m - x, pose.y_m - y])
            holds = off @ np.linalg.solve(pose.covariance_m2, off) < 5.99
            rows.append((pose.stamp_ns, *off, math.remainder(pose.heading_rad - heading, math.tau), holds))
    ns, x_m, y_m, heading_rad, holds = np.array(rows).T
    return Errors((ns - START_NS) * 1e-9, np.hypot(x_m, y_m), heading_rad, holds), core


def rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


# --- in the filter ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "most_m", "most_rad", "first_s"),
    [
        (("imu", "gps", "gps_velocity"), 0.5, 0.06, 15),
        (("imu", "gps"), 0.8, 0.1, 35),
        (("gps", "gps_velocity"), 0.6, 0.4, 15),
        (("gps",), 1.0, 0.9, 15),
    ],
    ids=["IMU and Doppler", "IMU and fixes", "Doppler alone", "fixes alone"],
)
def test_a_machine_without_wheels_is_located(
    kinds: tuple[str, ...], most_m: float, most_rad: float, first_s: float
) -> None:
    made, vehicle = drive(S_BENDS, VEHICLE), equipped(*kinds)
    errors, core = located(made, vehicle, sensed(made, vehicle))
    assert core.localiser.is_proven
    assert errors.seconds[0] < first_s
    assert rms(errors.off_m) < most_m
    assert errors.holds.mean() > 0.9
    assert np.quantile(abs(errors.heading_rad), 0.95) < most_rad


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_machine_that_reverses_first_is_turned_the_right_way_by_its_accelerometer(seed: int) -> None:
    made, vehicle = drive(REVERSES_FIRST, VEHICLE), equipped("imu", "gps", "gps_velocity")
    errors, core = located(made, vehicle, sensed(made, vehicle, seed))
    assert core.counters["first_motion_reversed"] == 1
    assert abs(errors.heading_rad).max() < 0.15
    assert rms(errors.off_m) < 0.6


@pytest.mark.slow
def test_wheels_that_fall_silent_for_a_while_leave_a_good_pose() -> None:
    made, vehicle = drive(S_BENDS, VEHICLE), equipped("imu", "gps", "gps_velocity", "encoder")
    readings = [
        r for r in sensed(made, vehicle) if not (isinstance(r, Encoder) and 20 < (r.stamp_ns - START_NS) * 1e-9 < 50)
    ]
    errors, core = located(made, vehicle, readings)
    silent = (errors.seconds > 20) & (errors.seconds < 50)
    assert rms(errors.off_m[silent]) < 0.6
    assert errors.holds[silent].mean() > 0.9
    assert abs(errors.heading_rad).max() < 0.1
    assert core.counters["wheels_gated"] == 0  # consistent on return
    driven_m = float(np.abs(made.speed_mps).sum() * 0.01)
    assert core.dead_reckoning.distance_m == pytest.approx(driven_m, rel=0.05)


@pytest.mark.slow
def test_a_gyro_s_bias_shows_while_no_speed_over_ground_does() -> None:
    made = drive((Leg(4, 0.6), Leg(10, 0, 0.1), Leg(4, -0.6), Leg(30)), VEHICLE)
    vehicle = equipped("imu", "gps", "gps_velocity")
    _, core = located(made, vehicle, sensed(made, vehicle))
    assert core.counters["standstill_used"] > 300
    belief = core.localiser.belief
    assert belief
    assert belief.x[15] == pytest.approx(0.003, abs=3e-4)


@pytest.mark.slow
def test_a_receiver_alone_keeps_its_heading_while_it_stands() -> None:
    made, vehicle = (
        drive((Leg(4, 0.6), Leg(10, 0, 0.1), Leg(4, -0.6), Leg(60), Leg(4, 0.6), Leg(8)), VEHICLE),
        equipped("gps", "gps_velocity"),
    )
    errors, core = located(made, vehicle, sensed(made, vehicle))
    belief = core.localiser.belief
    assert belief
    assert abs(errors.heading_rad).max() < 0.5
    assert errors.holds.mean() > 0.9


# --- samples ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_samples_have_the_slope_and_say_why_there_is_no_resistance() -> None:
    ground = Ground(0.04, ahead_rad=0.06, left_rad=-0.03)
    made, vehicle = drive(S_BENDS, VEHICLE, ground=ground), equipped("imu", "gps", "gps_velocity")
    pipeline = Pipeline(SITE, vehicle, EKF)
    samples = [*(pipeline.step([r]).final for r in sensed(made, vehicle)), pipeline.finish().final]
    rows = np.concatenate(samples)
    assert len(rows) > 100
    assert np.isnan(rows["c_rr"]).all()
    assert pipeline.health()["without_resistance"] == {"no_wheels": len(rows)}
    driven_m = float(np.abs(made.speed_mps).sum() * 0.01)
    assert rows["distance_m"].sum() == pytest.approx(driven_m, rel=0.1)
    start = made.heading_rad[0]
    c, s, ahead, left = math.cos(start), math.sin(start), math.tan(ground.ahead_rad), math.tan(ground.left_rad)
    off = np.stack([rows["grade_e"] - (c * ahead - s * left), rows["grade_n"] - (s * ahead + c * left)])
    assert rms(np.hypot(*off)) < 0.01
    stated = rows["grade_var"]
    assert 0.2 < float((off**2).mean() / stated.mean()) < 2.0


# --- speed over ground -----------------------------------------------------------------------------------------------


def second(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def velocity(seconds: float, east: float, north: float, std: float = 0.05) -> GpsVelocity:
    return GpsVelocity("doppler", second(seconds), east, north, std**2, std**2)


def place(seconds: float, east_m: float, std: float = 0.5) -> Gps:
    lon_deg = 8.4 + east_m / 111_200 / math.cos(math.radians(49.0))
    return Gps("gps", second(seconds), 49.0, lon_deg, 0.0, std**2, std**2, 1.0)


def test_the_speed_is_that_of_base_link_and_has_its_sign() -> None:
    """In a bend the antenna, 2 m ahead, moves sideways; the machine drives north, then reverses."""
    tracker, sensor = GroundTracker(turns=True), replace(DOPPLER, mount=Mount((2.0, 0.0, 3.0)))
    still = tracker.update(velocity(-1, 0.0, 0.1), sensor, 0.0)
    assert still
    assert still.stands
    assert still.speed_mps == 0.0
    ahead = tracker.update(velocity(0, 0.0, 2.0), sensor, 0.0)
    bent = tracker.update(velocity(1, -2.0 * math.sin(0.2) - 0.4, 2.0 * math.cos(0.2)), sensor, 0.2)
    back = tracker.update(velocity(2, 1.5 * math.sin(0.2), -1.5 * math.cos(0.2)), sensor, 0.2)
    assert ahead
    assert bent
    assert back
    assert ahead.speed_mps == 2.0
    assert bent.speed_mps == pytest.approx(2.0, abs=0.1)
    assert back.speed_mps == pytest.approx(-1.5, abs=0.05)


def test_the_first_motion_is_ahead_unless_wheels_say_otherwise() -> None:
    def speed(east_mps: float, wheels_mps: float | None) -> float:
        tracker = GroundTracker(turns=True)
        shown = [tracker.update(velocity(i, east_mps, 0.0), DOPPLER, 0.0, wheels_mps) for i in range(2)]
        return shown[1].speed_mps if shown[1] else math.nan

    assert speed(1.0, None) == pytest.approx(1.0)
    assert speed(1.0, -1.0) == pytest.approx(-1.0)
    assert speed(0.1, None) == 0.0


def test_fixes_make_a_speed_once_they_are_further_apart_than_by_noise_and_repeats_make_none() -> None:
    tracker, gps = GroundTracker(turns=True), SensorConfig("gps", "gps")
    held = [place(0.2 * i, 2.0 * (0.2 * (i // 5 * 5))) for i in range(40)]  # a new place each second
    shown = [speed for fix in held if (speed := tracker.update(fix, gps, 0.0))]
    assert [speed.speed_mps for speed in shown] == pytest.approx([2.0] * len(shown), rel=0.01)
    assert len(shown) >= 2
    assert not any(speed.stands for speed in shown)


def test_without_a_turn_sensor_the_course_is_the_turn() -> None:
    reckoning = DeadReckoning(equipped("gps", "gps_velocity"), 0.1)
    for i in range(40):
        course = min(0.1 * i, 2.0)
        reckoning.update(velocity(0.5 * i, 2.0 * math.cos(course), 2.0 * math.sin(course)), DOPPLER)
    assert reckoning.pose.angle_rad == pytest.approx(2.0, abs=0.01)
    assert reckoning.travel_m == pytest.approx(2.0 * 19.5, rel=0.01)


def test_a_wheel_that_comes_back_counts_nothing_that_speed_over_ground_has_counted() -> None:
    vehicle = replace(VEHICLE, sensors=(SensorConfig("odo", "odometry"), DOPPLER))
    reckoning, odo = DeadReckoning(vehicle, 0.0), vehicle.sensors[0]
    for i in range(601):
        if not 200 < i < 400:
            reckoning.update(Odometry("odo", second(0.05 * i), 2.0, 0.0, 0.0), odo)
        if i % 10 == 5:
            reckoning.update(velocity(0.05 * i, 2.0, 0.0), DOPPLER)
    assert reckoning.distance_m == pytest.approx(60.0, abs=1.1)
    assert not reckoning.is_silent(second(30.0))
