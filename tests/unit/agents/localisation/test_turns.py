"""Machines without IMU: turn rate from odometry, else steering, else none."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from agents.dead_reckoning import turn_source
from agents.localisation.filters.belief import Belief
from agents.localisation.filters.motion import motion
from agents.localisation.filters.state import YAW_RATE, Layout
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, Odometry, Reading, Steering
from tests.unit.agents.drives import (
    LEVER_M,
    START_NS,
    Drive,
    Leg,
    RunLocaliser,
    drive,
    localiser,
    reckoned,
    seconds,
    thinned,
)

WHEELBASE_M = 2.5
EIGHT = [Leg(6, 0.5), Leg(4), *[Leg(25, 0, 0.25), Leg(25, 0, -0.25)] * 2]  # 3 m/s, circles of 12 m
BEND = [Leg(6, 0.5), Leg(4), Leg(25, 0, 0.25)]
DARK_S = 80.0, 90.0
ERROR = Layout(imus=1).gyro_bias(0)
GPS, ENCODER = SensorConfig("gps-1", "gps", Mount(LEVER_M)), SensorConfig("wheels", "encoder")
STEERING, ODOMETRY = SensorConfig("steer", "steering"), SensorConfig("odom", "odometry")
SURE = SensorConfig("b", "odometry", std={"rate": 0.01})


def truck(*sensors: SensorConfig) -> MachineConfig:
    return MachineConfig("truck", wheelbase_m=WHEELBASE_M, wheel_radius_m=0.4, sensors=(*sensors, GPS))


@dataclass(frozen=True)
class Wrong:
    """Sensor errors."""

    steering_rad: float = 0.0
    rate_radps: float = 0.0
    fixes: bool = True


def driven(
    vehicle: MachineConfig, wrong: Wrong, legs: list[Leg] | None = None, gps_hz: int = 5, seed: int = 0
) -> Drive:
    """Steering and odometry at 20 Hz, fixes with slow and white errors."""
    made, rng = drive(legs or EIGHT, vehicle), np.random.default_rng(seed)
    fixes = [r for r in made.readings if isinstance(r, Gps)][:: 5 // gps_hz]
    slow = np.zeros(2)
    readings: list[Reading] = [r for r in made.readings if not isinstance(r, Gps)]
    for fix in fixes:
        slow = slow * math.exp(-1 / (45 * gps_hz)) + rng.normal(size=2) * math.sqrt(2 / (45 * gps_hz))
        east, north = (slow + 0.5 * rng.normal(size=2)) * wrong.fixes / 111_200
        readings.append(replace(fix, lat_deg=fix.lat_deg + north, lon_deg=fix.lon_deg + east / 0.656))
    rates = np.gradient(made.heading_rad, 0.01)
    for stamp, speed, rate in list(zip(made.stamps_ns, made.speed_mps.tolist(), rates.tolist(), strict=True))[::5]:
        angle = math.atan(WHEELBASE_M * rate / speed) if speed > 0.1 else 0.0
        if vehicle.sensor("steer"):
            readings.append(Steering("steer", stamp, angle + wrong.steering_rad))
        if vehicle.sensor("odom"):
            readings.append(Odometry("odom", stamp, speed, 0.0, rate + wrong.rate_radps))
    return replace(made, readings=sorted(readings, key=lambda r: r.stamp_ns))


def run(vehicle: MachineConfig, readings: list[Reading], **options: Any) -> tuple[RunLocaliser, list[Belief]]:
    """The localiser and its newest beliefs."""
    located = localiser(vehicle, **options)
    return located, located.beliefs(readings)


def without_fixes(readings: list[Reading]) -> list[Reading]:
    return [r for r in readings if not isinstance(r, Gps) or not DARK_S[0] < seconds(r) < DARK_S[1]]


def errors(made: Drive, beliefs: list[Belief], from_s: float = 0.0, to_s: float = 1e9) -> list[float]:
    return [made.off_m(b) for b in beliefs if from_s <= seconds(b) <= to_s]


# --- sources of the turn rate ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sensors", "expected"),
    [
        ((STEERING, ODOMETRY, SensorConfig("gyro", "imu")), "gyro"),
        ((STEERING, ODOMETRY, SensorConfig("gyro", "imu", measures=("force",))), "odom"),
        ((STEERING, ODOMETRY, SensorConfig("gyro", "imu", use=False)), "odom"),
        ((STEERING, replace(ODOMETRY, measures=("speed",))), "steer"),
        ((ENCODER, replace(STEERING, use=False)), None),
        # the source of the least stated error
        ((ODOMETRY, SURE, replace(SURE, name="a", std={"rate": 0.2})), "b"),
        ((replace(SURE, name="a", std={"rate": 0.2}), ODOMETRY), "a"),
    ],
)
def test_an_imu_is_asked_first_then_odometry_then_steering(
    sensors: tuple[SensorConfig, ...], expected: str | None
) -> None:
    source = turn_source(truck(*sensors))
    assert (source.name if source else None) == expected


@pytest.mark.parametrize(
    "sensors", [(ENCODER, STEERING), (ODOMETRY,), (ENCODER, replace(ODOMETRY, measures=("rate",)))]
)
def test_dead_reckoning_turns_without_an_imu(sensors: tuple[SensorConfig, ...]) -> None:
    vehicle = truck(*sensors)
    made = driven(vehicle, Wrong(), [Leg(6, 0.5), Leg(4 * math.pi, 0.0, 0.25)])
    reckoning = reckoned(vehicle, made.readings)
    x, y, _ = made.at(made.stamps_ns[-1])
    moved = complex(x - 10, y - 20) * complex(math.cos(0.7), -math.sin(0.7))
    assert reckoning.angle_rad == pytest.approx(math.pi, abs=0.02)
    assert reckoning.travel_m == pytest.approx(9 + 3 * 4 * math.pi, abs=0.2)
    assert (reckoning.pose.x_m, reckoning.pose.y_m) == pytest.approx((moved.real, moved.imag), abs=0.3)


def test_old_steering_angle_turns_nothing() -> None:
    vehicle = truck(ENCODER, STEERING)
    readings: list[Reading] = [Steering("steer", START_NS, 0.2)]
    readings += [Encoder("wheels", START_NS + i * 50_000_000, 2.0 * i, 2.0 * i) for i in range(200)]
    reckoning = reckoned(vehicle, readings)
    turned_m = 2.0 * 39 / 100 * 2 * math.pi * 0.4  # over 2 s
    assert reckoning.angle_rad == pytest.approx(turned_m * math.tan(0.2) / WHEELBASE_M, rel=0.03)


# --- results ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "wrong", "gps_hz", "engine"),
    [
        ((ENCODER, STEERING), Wrong(steering_rad=math.radians(1)), 1, "ekf"),
        pytest.param((ODOMETRY,), Wrong(rate_radps=0.01), 5, "ukf", marks=pytest.mark.nightly),
    ],
)
def test_a_machine_without_imu_is_located_and_holds_through_ten_seconds_without_gps(
    sensors: tuple[SensorConfig, ...], wrong: Wrong, gps_hz: int, engine: str
) -> None:
    """GPS error 1.6 m rms; in 10 s it moves 30 m and turns 2.5 rad."""
    vehicle, seed = truck(*sensors), 3
    made = driven(vehicle, wrong, gps_hz=gps_hz, seed=seed)
    located, beliefs = run(vehicle, without_fixes(made.readings), filter=engine)
    shown = f"seed={seed} {located.counters}"
    assert max(errors(made, beliefs, 30.0)) < 4.5, shown
    assert max(errors(made, beliefs, *DARK_S)) < 4.0, shown
    assert made.turned_rad(beliefs[-1]) < 0.15, shown
    assert located.counters["gps-1_gated"] == 0, shown


@pytest.mark.parametrize(("sensors", "per_s"), [((ENCODER, STEERING), 0.0), ((ODOMETRY,), 2 * 0.02**2 / 60)])
def test_the_error_of_a_turn_is_unsure_at_first_and_that_of_odometry_changes(
    sensors: tuple[SensorConfig, ...], per_s: float
) -> None:
    """A scale error differs by bend; a steering offset stays."""
    vehicle = truck(*sensors)
    located, beliefs = run(vehicle, driven(vehicle, Wrong(), [Leg(1)]).readings, start=(10.0, 20.0, 0.7))
    assert beliefs[0].P[ERROR, ERROR] == pytest.approx(0.02**2, rel=0.01)
    assert motion(located._tracker.fusion.model, beliefs[0], 2.0).Q[ERROR, ERROR] == pytest.approx(
        2 * (per_s + 5e-5**2)
    )


def test_nothing_that_tells_the_turn_is_counted_and_no_crash() -> None:
    vehicle = truck(ENCODER, SensorConfig("ahrs", "attitude"))
    made = driven(vehicle, Wrong(fixes=False), BEND)
    located, beliefs = run(vehicle, thinned(made.readings))
    assert located.counters["turn_unknown"] > 500
    assert located.counters["turn_used"] == 0
    assert float(np.median(errors(made, beliefs, 20.0))) < 2.0


def test_a_step_without_a_turn_leaves_the_rate_to_what_is_known() -> None:
    """Odometry falls silent in a bend: the rate becomes unknown, not zero."""
    vehicle = truck(ENCODER, replace(ODOMETRY, measures=("rate",)))
    made = driven(vehicle, Wrong(fixes=False), [Leg(6, 0.5), Leg(6), Leg(20, 0, 0.25)])
    readings = [r for r in made.readings if not isinstance(r, Odometry) or seconds(r) < 20]
    last = run(vehicle, readings)[1][-1]
    assert last.P[YAW_RATE, YAW_RATE] > 0.01
    assert last.x[YAW_RATE] == pytest.approx(0.25, abs=0.2)
