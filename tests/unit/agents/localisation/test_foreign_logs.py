"""What logs of other machines are like: they begin in motion, have few readings a second, sensors in any order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter

import numpy as np
import pytest

from agents.localisation.consistency import CANNOT_TELL, CONSISTENT, INCONSISTENT
from agents.localisation.filters.belief import Belief, PoseBelief
from agents.localisation.filters.state import PITCH, ROLL
from agents.localisation.localiser import LocalisationConfig, Localiser
from agents.positioning import PipelineConfig, Positioning
from protocol.machine.machine_config import FRONT, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Imu, Odometry, Reading
from tests.unit.agents.drives import LEVER_M, PROJECTION, SITE, START_NS, Drive, Leg, drive, fix

TOUR = (Leg(6, 1.0), Leg(6), *[Leg(12, 0, 0.2), Leg(5), Leg(12, 0, -0.2), Leg(5)] * 2)  # 6 m/s in bends of 30 m
GPS, ENCODER, ODOMETRY = (
    SensorConfig("gps", "gps", Mount(LEVER_M)),
    *(SensorConfig("wheels", kind, measures=("speed",)) for kind in ("encoder", "odometry")),
)
GYRO = SensorConfig("gyro", "imu", measures=("rate",))


def cart(*sensors: SensorConfig) -> MachineConfig:
    return MachineConfig("cart", wheel_radius_m=0.4, sensors=sensors)


def readings_of(
    vehicle: MachineConfig, made: Drive, rate_hz: float, seed: int, from_s: float = 0.0, slow_m: float = 1.0
) -> list[Reading]:
    """What its sensors read so many times a second, all at the same stamps.

    Fixes have a white error of 0.5 m per axis and a slow one of slow_m.
    """
    rng, every = np.random.default_rng(seed), round(100 / rate_hz)
    rates = np.gradient(made.heading_rad, 0.01)
    travel = np.cumsum(made.speed_mps) * 0.01
    slow: dict[str, np.ndarray] = {s.name: rng.normal(size=2) for s in vehicle.sensors}
    readings: list[Reading] = []
    for i in range(round(from_s * 100) + every, len(made.stamps_ns), every):
        stamp, speed, rate = made.stamps_ns[i], float(made.speed_mps[i]), float(rates[i])
        for s in vehicle.sensors:
            y = s.mount.xyz_m[1]
            if s.kind == "imu":
                pitch, roll, turn, ahead, left = rng.normal(size=5) * (0.003, 0.003, 0.003, 0.1, 0.1)
                readings.append(Imu(s.name, stamp, roll, pitch, rate + turn, ahead, left + speed * rate, 9.81))
            elif s.kind == "odometry":
                readings.append(Odometry(s.name, stamp, speed - y * rate + 0.02 * rng.normal(), 0.0, rate))
            elif s.kind == "encoder":
                ticks = math.floor((travel[i] - y * made.heading_rad[i]) / (2 * math.pi * 0.4) * s.ticks_per_rev)
                readings.append(Encoder(s.name, stamp, ticks, ticks))
            elif s.kind == "gps":
                fade = math.exp(-0.01 * every / s.drift_time_s)
                slow[s.name] = fade * slow[s.name] + math.sqrt(1 - fade**2) * rng.normal(size=2)
                east, north = slow_m * slow[s.name] + 0.5 * rng.normal(size=2)
                heading = float(made.heading_rad[i])
                readings.append(fix(s, stamp, made.x_m[i] + east, made.y_m[i] + north, heading, 1.25))
    return readings


def located(
    vehicle: MachineConfig, readings: Sequence[Reading], engine: str = "ekf"
) -> tuple[Positioning, list[PoseBelief], list[Belief]]:
    """Poses and beliefs as they were known after each reading."""
    config = PipelineConfig(localisation=LocalisationConfig(filter=engine, slip=0.0, slip_soft=0.0))
    positioning, poses, beliefs = Positioning(SITE, vehicle, config), [], []
    for reading in readings:
        positioning.step([reading])
        pose, belief = positioning.pose, positioning.localiser.belief
        if pose and belief and (not poses or pose.stamp_ns > poses[-1].stamp_ns):
            poses.append(pose)
            beliefs.append(belief)
    return positioning, poses, beliefs


def net_m(made: Drive, poses: Sequence[PoseBelief]) -> float:
    """Root mean square of the distance from the true place."""
    off = [math.dist((p.x_m, p.y_m), made.at(p.stamp_ns)[:2]) for p in poses]
    return float(np.sqrt(np.mean(np.square(off))))


def scale_of(positioning: Positioning, belief: Belief) -> tuple[float, float]:
    """The wheels' scale and its standard deviation."""
    state = positioning.localiser._tracker._model.layout.wheel_scales.start
    return float(belief.x[state]), math.sqrt(belief.P[state, state])


# --- a log that begins in motion -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("wheels", "rate_hz", "engine"), [(ENCODER, 20, "ekf"), (ODOMETRY, 5, "ukf")])
def test_a_log_that_begins_in_motion_gates_no_wheels_and_bends_no_scale(
    wheels: SensorConfig, rate_hz: float, engine: str
) -> None:
    vehicle = cart(SensorConfig("imu", "imu"), wheels, GPS)
    made = drive(TOUR, vehicle)
    positioning, _, beliefs = located(
        vehicle, readings_of(vehicle, made, rate_hz, seed=1, from_s=9.0)[: 40 * rate_hz], engine
    )
    assert positioning.counters["wheels_gated"] == 0
    scale, std = scale_of(positioning, beliefs[5])
    assert abs(scale) < max(2 * std, 0.02)


@pytest.mark.parametrize("wheels", [ENCODER, ODOMETRY])
def test_wheels_that_pause_while_the_machine_brakes_come_back_with_their_new_speed(wheels: SensorConfig) -> None:
    legs = (Leg(6, 1.0), Leg(20), Leg(4, -1.2), Leg(20))
    vehicle = cart(SensorConfig("imu", "imu"), wheels, GPS)
    made = drive(legs, vehicle)
    pause_ns = START_NS + 25 * 10**9, START_NS + 31 * 10**9
    readings = [
        r
        for r in readings_of(vehicle, made, 20, seed=1)
        if r.sensor != "wheels" or not pause_ns[0] < r.stamp_ns < pause_ns[1]
    ]
    positioning, _, _ = located(vehicle, readings)
    assert positioning.counters["wheels_gated"] == 0
    assert positioning.counters["standstill_used"] == 0


# --- any order -------------------------------------------------------------------------------------------------------

MANY = (
    replace(GPS, delay_s=0.1),
    SensorConfig("gps-2", "gps", delay_s=0.1),
    SensorConfig("imu", "imu"),
    SensorConfig("gyro", "imu", measures=("rate",)),
    SensorConfig("wheels", "odometry", measures=("speed",)),
    SensorConfig("left", "encoder", Mount((0.0, 0.7, 0.0))),
)


def shuffled_stamps(readings: Sequence[Reading], rng: np.random.Generator) -> list[Reading]:
    """Readings of each stamp in another order."""
    groups = [list(group) for _, group in groupby(readings, key=attrgetter("stamp_ns"))]
    return [group[i] for group in groups for i in rng.permutation(len(group))]


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "rate_hz"), [("ekf", 20), ("ukf", 5)])
@pytest.mark.nightly
def test_no_order_of_sensor_tables_and_of_readings_of_a_stamp_changes_a_bit(engine: str, rate_hz: float) -> None:
    vehicle = cart(*MANY)
    readings = readings_of(vehicle, drive(TOUR, vehicle), rate_hz, seed=4)[: 25 * rate_hz * len(MANY)]
    _, poses, _ = located(vehicle, readings, engine)
    assert len(poses) > 50
    for seed in range(2):
        rng = np.random.default_rng(seed)
        swapped = replace(vehicle, sensors=tuple(MANY[i] for i in rng.permutation(len(MANY))))
        _, others, _ = located(swapped, shuffled_stamps(readings, rng), engine)
        assert [repr(p) for p in others] == [repr(p) for p in poses], f"seed={seed}"


def test_a_reading_counts_in_the_step_of_its_stamp() -> None:
    """At 5 Hz, where a machine starts to turn and to drive at once, both show at once in whatever order they come."""
    vehicle = cart(GYRO, ODOMETRY, GPS)
    made = drive(TOUR, vehicle)
    readings = readings_of(vehicle, made, 5, seed=2)
    readings.sort(key=lambda r: (r.stamp_ns, r.sensor == "gyro"))
    net = net_m(made, located(vehicle, readings)[1])
    readings.sort(key=lambda r: (r.stamp_ns, r.sensor != "gyro"))
    assert net_m(made, located(vehicle, readings)[1]) == net


# --- what a sensor provides decides what is estimated ----------------------------------------------------------------


AHRS, JOINT = SensorConfig("ahrs", "attitude"), SensorConfig("joint", "articulation")
IMU, FORCE = SensorConfig("imu", "imu"), SensorConfig("force", "imu", measures=("force",))


@pytest.mark.parametrize(
    ("sensors", "profile", "in_space"),
    [
        ((IMU,), "default", True),
        ((GYRO,), "default", False),
        ((FORCE,), "default", False),
        ((GYRO, FORCE), "default", True),
        ((replace(IMU, use=False),), "default", False),
        ((replace(IMU, frame=FRONT),), "default", False),  # nobody knows how it lies against the rear frame
        ((replace(IMU, frame=FRONT), JOINT), "default", True),
        ((AHRS,), "paper", True),
        ((AHRS,), "default", False),
        ((replace(AHRS, mode="relative"), GYRO), "default", True),
        ((replace(AHRS, mode="differential"), GYRO), "default", False),
        ((replace(AHRS, mode="differential"), FORCE), "default", True),
        ((replace(AHRS, measures=("heading",)),), "paper", False),
        ((replace(AHRS, frame=FRONT),), "paper", False),
    ],
)
def test_tilt_is_estimated_where_something_shows_it_and_holds_it(
    sensors: tuple[SensorConfig, ...], profile: str, in_space: bool
) -> None:
    config = LocalisationConfig(profile=profile)
    assert Localiser(cart(*sensors, ODOMETRY, GPS), PROJECTION, config)._tracker._model.on_plane is not in_space


def test_a_gyro_without_accelerometer_does_not_make_the_tilt_wander() -> None:
    vehicle = cart(GYRO, ODOMETRY, GPS)
    made = drive(TOUR, vehicle)
    positioning, _, beliefs = located(vehicle, readings_of(vehicle, made, 10, seed=3), "ukf")
    assert max(abs(float(b.x[state])) for b in beliefs for state in (ROLL, PITCH)) < 1e-3
    assert abs(scale_of(positioning, beliefs[-1])[0]) < 0.02
    assert positioning.counters["gyro_gated"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "rate_hz"),
    [((GYRO, ODOMETRY), 20), ((SensorConfig("odometry", "odometry"),), 5), ((IMU, ENCODER), 5)],
)
def test_both_filters_agree_where_the_model_is_the_same(sensors: tuple[SensorConfig, ...], rate_hz: float) -> None:
    """Where nothing but the start's wide heading is far from linear; a log that begins in motion."""
    vehicle = cart(*sensors, GPS)
    made = drive(TOUR, vehicle)
    readings = readings_of(vehicle, made, rate_hz, seed=1, from_s=9.0)
    (_, ekf, _), (_, ukf, _) = (located(vehicle, readings, engine) for engine in ("ekf", "ukf"))
    apart = [math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) for a, b in zip(ekf, ukf, strict=True)]
    assert max(apart) < 0.1
    assert net_m(made, ukf) == pytest.approx(net_m(made, ekf), rel=0.05)


# --- what nobody can know --------------------------------------------------------------------------------------------


def judged(slow_m: float, time_s: float, receivers: int, seed: int) -> tuple[float, set[str], float]:
    """Share of time in the 95 % ellipse, verdicts on the receivers, and the largest NIS.

    The slow error has this standard deviation and correlation time; stated are 1 m and 45 s.
    """
    names = [f"gps-{i + 1}" for i in range(receivers)]
    vehicle = cart(IMU, ODOMETRY, *(SensorConfig(name, "gps", drift_time_s=time_s) for name in names))
    legs = (Leg(6, 1.0), Leg(6), *[Leg(12, 0, 0.2), Leg(5), Leg(12, 0, -0.2), Leg(5)] * 10)
    made = drive(legs, vehicle)
    stated = replace(vehicle, sensors=tuple(replace(s, drift_time_s=45.0, drift_share=0.8) for s in vehicle.sensors))
    positioning, poses, _ = located(stated, readings_of(vehicle, made, 5, seed, slow_m=slow_m))
    off = np.array([(p.x_m, p.y_m) for p in poses]) - [made.at(p.stamp_ns)[:2] for p in poses]
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv([p.covariance_m2 for p in poses]), off)
    consistency = positioning.localiser.consistency.values()
    return float((nees < 5.99).mean()), {c.verdict for c in consistency}, max(c.nis for c in consistency)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("receivers", "slow_m", "time_s", "covers", "verdict"),
    [
        (1, 1.0, 45.0, True, CANNOT_TELL),
        (1, 3.0, 405.0, False, CANNOT_TELL),  # innovations are as white and small as before
        (2, 1.0, 45.0, True, CONSISTENT),
        (2, 3.0, 405.0, False, INCONSISTENT),  # the receivers disagree by more than they state
    ],
)
def test_an_ellipse_that_misses_the_truth_for_long_is_not_said_to_hold(
    receivers: int, slow_m: float, time_s: float, *, covers: bool, verdict: str
) -> None:
    seed = 5
    coverage, verdicts, nis = judged(slow_m, time_s, receivers, seed)
    assert (coverage > 0.8) is covers, f"seed={seed} {coverage}"
    assert verdict in verdicts, f"seed={seed} {verdicts}"
    assert (CONSISTENT in verdicts) is (verdict == CONSISTENT), f"seed={seed} {verdicts}"
    assert nis < 1.3, f"seed={seed}"
