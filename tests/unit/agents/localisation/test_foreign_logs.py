"""Logs of other machines: start in motion, low rates, any sensor order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief, PoseBelief
from agents.localisation.localiser import LocalisationConfig, Localiser
from agents.positioning import PipelineConfig, Positioning
from protocol.machine.machine_config import FRONT, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Imu, Odometry, Reading
from tests.tiers import by_night
from tests.unit.agents.drives import LEVER_M, PROJECTION, SITE, START_NS, Drive, Leg, drive, fix

TOUR = (Leg(6, 1.0), Leg(6), *[Leg(12, 0, 0.2), Leg(5), Leg(12, 0, -0.2), Leg(5)] * 2)  # 6 m/s, bends of 30 m
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
    """Readings at this rate, equal stamps. Fixes: white error 0.5 m per axis, slow error slow_m."""
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
    """Poses and beliefs after each reading."""
    config = PipelineConfig(localisation=LocalisationConfig(filter=engine, slip=0.0, slip_soft=0.0))
    positioning, poses, beliefs = Positioning(SITE, vehicle, config), [], []
    for reading in readings:
        positioning.step([reading])
        pose, belief = positioning.pose, positioning.localiser.belief
        if pose and belief and (not poses or pose.stamp_ns > poses[-1].stamp_ns):
            poses.append(pose)
            beliefs.append(belief)
    return positioning, poses, beliefs


def scale_of(positioning: Positioning, belief: Belief) -> tuple[float, float]:
    """Wheel scale, std."""
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


@pytest.mark.parametrize("wheels", by_night([ENCODER, ODOMETRY], day=[ENCODER]))
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


AHRS, JOINT = SensorConfig("ahrs", "attitude"), SensorConfig("joint", "articulation")
IMU, FORCE = SensorConfig("imu", "imu"), SensorConfig("force", "imu", measures=("force",))


@pytest.mark.parametrize(
    ("sensors", "profile", "in_space"),
    [
        ((IMU,), "default", True),
        ((GYRO,), "default", False),
        ((GYRO, FORCE), "default", True),
        ((replace(IMU, frame=FRONT),), "default", False),  # unknown place against the rear frame
        ((replace(IMU, frame=FRONT), JOINT), "default", True),
        ((AHRS,), "paper", True),
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
