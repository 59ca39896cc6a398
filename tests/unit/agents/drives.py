"""Readings of synthetic drives with known physics and of simulated ones, for tests of the agents."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np

from agents.dead_reckoning import DeadReckoning
from agents.estimation.balance import front_share, squat_rad
from agents.localisation.filters.belief import Belief, PoseBelief
from agents.localisation.filters.state import YAW
from agents.localisation.localiser import STEP_S, LocalisationConfig, Localiser
from agents.stream_order import by_stamp
from protocol.arrays import Floats, Table
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Articulation, Attitude, Encoder, Gps, Imu, Payload, Reading, Torque
from protocol.machine.samples import empty
from protocol.site.site_config import Projection, SiteConfig
from protocol.units import GRAVITY_MPS2
from sim.config import SimConfig
from sim.simulator import Simulator

SITE = SiteConfig("lot", 49.01, 8.4, 120.0)
PROJECTION = Projection(SITE)
START = (10.0, 20.0, 0.7)  # where drives start: east, north [m], heading [rad]
START_NS = 1_767_225_600_000_000_000
TRUE_STEP_S = 0.01
LEVER_M = (0.8, 0.3, 3.0)


def machine(mount: Mount | None = None, receivers: int = 1, **options: Any) -> MachineConfig:
    sensors = [
        SensorConfig("imu", "imu", mount or Mount()),
        SensorConfig("torque", "torque"),
        SensorConfig("wheels", "encoder"),
        *(SensorConfig(f"gps-{i + 1}", "gps", Mount(LEVER_M)) for i in range(receivers)),
    ]
    return MachineConfig("loader-1", sensors=tuple(sensors), **options)


VEHICLE = machine()


def changed_sensor(vehicle: MachineConfig, name: str, **options: Any) -> MachineConfig:
    return replace(vehicle, sensors=tuple(replace(s, **options) if s.name == name else s for s in vehicle.sensors))


@dataclass(frozen=True)
class Leg:
    """Seconds of constant acceleration and turn rate, loaded, articulated to the left."""

    seconds: float
    accel_mps2: float = 0.0
    turn_radps: float = 0.0
    payload_kg: float = 0.0
    bend_rad: float = 0.0


@dataclass(frozen=True)
class Ground:
    """Rolling resistance and slope angles of a plane, ahead and left of the starting machine, positive uphill.

    A turn on the plane changes the machine's slopes.
    """

    c_rr: float = 0.04
    ahead_rad: float = 0.0
    left_rad: float = 0.0

    def turned(self, by_rad: float) -> Ground:
        """After a turn to the left."""
        c, s, ahead, left = math.cos(by_rad), math.sin(by_rad), math.sin(self.ahead_rad), math.sin(self.left_rad)
        return replace(self, ahead_rad=math.asin(c * ahead + s * left), left_rad=math.asin(c * left - s * ahead))


@dataclass(frozen=True)
class Drive:
    """Truth at 100 Hz and noise-free readings."""

    stamps_ns: list[int]
    x_m: Floats
    y_m: Floats
    heading_rad: Floats
    speed_mps: Floats
    readings: list[Reading]

    def at(self, stamp_ns: int) -> tuple[float, float, float]:
        i = round((stamp_ns - START_NS) * 1e-9 / TRUE_STEP_S) - 1
        return float(self.x_m[i]), float(self.y_m[i]), float(self.heading_rad[i])

    def off_m(self, located: PoseBelief | Belief) -> float:
        """Position error."""
        x, y = located.x[:2] if isinstance(located, Belief) else (located.x_m, located.y_m)
        return math.dist((x, y), self.at(located.stamp_ns)[:2])

    def turned_rad(self, located: PoseBelief | Belief) -> float:
        """Heading error."""
        heading = float(located.x[YAW]) if isinstance(located, Belief) else located.heading_rad
        return abs(math.remainder(heading - self.at(located.stamp_ns)[2], math.tau))


def drive(
    legs: Iterable[Leg],
    vehicle: MachineConfig,
    *,
    ground: Ground | None = None,
    heading_rad: float = 0.7,
    without: Sequence[str] = (),
) -> Drive:
    """Drive from (10, 20) at rest: gyro, force, torque 100 Hz, wheels 20 Hz, fixes 5 Hz."""
    return _drive(tuple(legs), vehicle, ground or Ground(), heading_rad, tuple(without))


@lru_cache(maxsize=32)  # shared by many tests
def _drive(
    legs: tuple[Leg, ...], vehicle: MachineConfig, ground: Ground, heading_rad: float, without: tuple[str, ...]
) -> Drive:
    v, heading, x, y, distance = 0.0, heading_rad, 10.0, 20.0, 0.0
    rows: list[tuple[float, ...]] = []
    readings: list[Reading] = []
    stamps: list[int] = []
    for leg in legs:
        for _ in range(round(leg.seconds / TRUE_STEP_S)):
            step_m = v * TRUE_STEP_S + 0.5 * leg.accel_mps2 * TRUE_STEP_S**2
            middle = heading + 0.5 * leg.turn_radps * TRUE_STEP_S
            x, y, distance = x + step_m * math.cos(middle), y + step_m * math.sin(middle), distance + step_m
            v, heading = v + leg.accel_mps2 * TRUE_STEP_S, heading + leg.turn_radps * TRUE_STEP_S
            rows.append((x, y, heading, v))
            stamps.append(START_NS + len(rows) * 10_000_000)
            here = ground.turned(heading - heading_rad)
            readings += _readings(vehicle, here, leg, rows[-1], distance, stamps[-1], len(rows))
    columns = np.array(rows).T
    seen = [r for r in readings if r.sensor not in without]
    return Drive(stamps, columns[0], columns[1], columns[2], columns[3], seen)


def _readings(
    vehicle: MachineConfig,
    ground: Ground,
    leg: Leg,
    row: tuple[float, ...],
    distance_m: float,
    stamp_ns: int,
    step: int,
) -> list[Reading]:
    x, y, heading, v = row
    readings: list[Reading] = []
    for sensor in vehicle.sensors:
        if sensor.kind == "imu":
            readings.append(_imu(sensor, vehicle, ground, leg, v, stamp_ns))
        elif sensor.kind == "torque":
            readings.append(Torque(sensor.name, stamp_ns, drive_n(vehicle, ground, leg, v) * vehicle.wheel_radius_m))
        elif sensor.kind == "encoder" and step % 5 == 0:
            ticks = distance_m / (2 * math.pi * vehicle.wheel_radius_m) * sensor.ticks_per_rev
            readings.append(Encoder(sensor.name, stamp_ns, ticks, ticks))
        elif sensor.kind == "articulation" and step % 5 == 0:
            readings.append(Articulation(sensor.name, stamp_ns, leg.bend_rad))
        elif sensor.kind == "payload" and step % 50 == 0:
            readings.append(Payload(sensor.name, stamp_ns, leg.payload_kg))
        elif sensor.kind == "gps" and step % 20 == 0:
            readings.append(fix(sensor, stamp_ns, x, y, heading))
    return readings


def drive_n(vehicle: MachineConfig, ground: Ground, leg: Leg, v: float) -> float:
    """Drive force balancing inertia, wheel inertia, slope and rolling resistance.

    An articulated machine's front axle climbs in another direction, with its share of the weight.
    """
    mass = vehicle.mass_kg + leg.payload_kg
    rolling = ground.c_rr * math.cos(ground.ahead_rad) * float(np.sign(v))
    uphill = math.sin(ground.ahead_rad)
    if leg.bend_rad:
        on_front = front_share(vehicle, leg.payload_kg, leg.accel_mps2 + GRAVITY_MPS2 * uphill)
        uphill += on_front * (math.sin(ground.turned(leg.bend_rad).ahead_rad) - uphill)
    rotating_kg = (vehicle.rotating_mass_factor - 1) * vehicle.mass_kg  # a load does not rotate
    return (mass + rotating_kg) * leg.accel_mps2 + mass * GRAVITY_MPS2 * (uphill + rolling)


def _imu(sensor: SensorConfig, vehicle: MachineConfig, ground: Ground, leg: Leg, v: float, stamp_ns: int) -> Imu:
    """On a body sitting on tyres."""
    up = GRAVITY_MPS2 * math.sqrt(1 - math.sin(ground.ahead_rad) ** 2 - math.sin(ground.left_rad) ** 2)
    ahead = leg.accel_mps2 + GRAVITY_MPS2 * math.sin(ground.ahead_rad)
    left = v * leg.turn_radps + GRAVITY_MPS2 * math.sin(ground.left_rad)
    nose_up = squat_rad(vehicle, leg.payload_kg, ahead)
    c, s = math.cos(nose_up), math.sin(nose_up)
    out_m = sensor.mount.xyz_m
    force = (c * ahead + s * up - leg.turn_radps**2 * out_m[0], left - leg.turn_radps**2 * out_m[1], c * up - s * ahead)
    sensor_from_base = sensor.mount.frame_from_sensor().T
    gyro = sensor_from_base @ (0.0, 0.0, leg.turn_radps)
    return Imu(sensor.name, stamp_ns, *gyro.tolist(), *(sensor_from_base @ force).tolist())


def fix(sensor: SensorConfig, stamp_ns: int, x: float, y: float, heading: float, variance_m2: float = 2.0) -> Gps:
    lever, c, s = sensor.mount.xyz_m, math.cos(heading), math.sin(heading)
    place = PROJECTION.to_geodetic(x + c * lever[0] - s * lever[1], y + s * lever[0] + c * lever[1], lever[2])
    return Gps(sensor.name, stamp_ns, *place, variance_m2, variance_m2, variance_m2)


def noisy(readings: Iterable[Reading], seed: int, *, torque: float = 1.0, force_mps2: float = 0.0) -> list[Reading]:
    """Poor sensors: torque scale, accelerometer zero ahead, white noise."""
    rng = np.random.default_rng(seed)
    noised: list[Reading] = []
    for r in readings:
        if isinstance(r, Torque):
            noised.append(replace(r, torque_nm=torque * r.torque_nm + 1200 * rng.standard_normal()))
        elif isinstance(r, Imu):
            ahead, left = 0.3 * rng.standard_normal(2)
            turns = 0.002 * rng.standard_normal(3)
            noised.append(
                replace(
                    r,
                    force_x_mps2=r.force_x_mps2 + force_mps2 + ahead,
                    force_y_mps2=r.force_y_mps2 + left,
                    gyro_x_radps=r.gyro_x_radps + turns[0],
                    gyro_y_radps=r.gyro_y_radps + turns[1],
                    gyro_z_radps=r.gyro_z_radps + turns[2],
                )
            )
        else:
            noised.append(r)
    return noised


def moved(
    readings: Iterable[Reading], north_m: float, *sensors: str, from_s: float = 0.0, to_s: float = math.inf
) -> list[Reading]:
    """Shift these receivers' fixes north for a time."""

    def is_moved(r: Reading) -> bool:
        return r.sensor in (sensors or ("gps-1",)) and after(r, from_s) and not after(r, to_s)

    return [
        replace(r, lat_deg=r.lat_deg + north_m / 111_200) if isinstance(r, Gps) and is_moved(r) else r for r in readings
    ]


def biased(readings: Iterable[Reading], radps: float) -> list[Reading]:
    """Add a vertical gyro bias."""
    return [replace(r, gyro_z_radps=r.gyro_z_radps + radps) if isinstance(r, Imu) else r for r in readings]


def thinned(readings: Iterable[Reading], every_ms: int = 50) -> list[Reading]:
    """Fewer fast readings, to save time."""
    return [r for r in readings if not isinstance(r, Imu | Torque) or r.stamp_ns % (every_ms * 1_000_000) == 0]


S_BEND = (Leg(4, 0.5), Leg(5), Leg(4, 0, 0.25), Leg(5), Leg(4, 0, -0.3), Leg(8))


@cache
def simulated(seed: int, seconds: float, **options: Any) -> tuple[SiteConfig, MachineConfig, list[Reading], Table]:
    """Site, machine, readings and true track of a simulated loader."""
    simulator = Simulator(SimConfig(world="fast", machines=1, seed=seed, seconds=seconds, **options), bundle_ms=1000)
    readings: list[Reading] = []
    for _ in range(simulator.bundles or 0):
        readings += simulator.advance()["loader-1"]
    return simulator.site, simulator.machines[0], readings, simulator.tracks()["loader-1"]


def seconds(made: Reading | PoseBelief | Belief) -> float:
    """Since the start."""
    return (made.stamp_ns - START_NS) * 1e-9


def after(reading: Reading, at_s: float) -> bool:
    return reading.stamp_ns > START_NS + at_s * 1e9


def with_ahrs(made: Drive, off_rad: float = 0.0, from_s: float = 0.0, variance: float = 1e-4) -> list[Reading]:
    """An AHRS at 20 Hz with a heading error."""
    more = [
        Attitude("ahrs", stamp, 0.0, 0.0, math.sin(half), math.cos(half), variance, variance, variance)
        for stamp, heading in zip(made.stamps_ns[::5], made.heading_rad[::5].tolist(), strict=True)
        for half in [(heading + off_rad) / 2]
        if stamp > START_NS + from_s * 1e9
    ]
    return sorted([*made.readings, *more], key=lambda r: r.stamp_ns)


def made_up_samples(n: int, seed: int = 0) -> Table:
    """Plausible, all different."""
    rng = np.random.default_rng(seed)
    rows = empty(n)
    rows["stamp_ns"] = START_NS + np.arange(n) * 100_000_000
    for name, low, high in (("x_m", 0, 200), ("y_m", 0, 150), ("c_rr", 0.01, 0.3), ("c_rr_var", 1e-5, 1e-3)):
        rows[name] = rng.uniform(low, high, n)
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.0
    rows["distance_m"] = 0.5
    return rows


def reckoned(vehicle: MachineConfig, readings: Iterable[Reading], slip: float = 0.0) -> DeadReckoning:
    dead_reckoning = DeadReckoning(vehicle, slip)
    for group in by_stamp(readings):
        for reading in group:
            dead_reckoning.update(reading, vehicle.sensor(reading.sensor))
    return dead_reckoning


class RunLocaliser(Localiser):
    """A localiser with the pipeline's dead reckoning."""

    def __init__(self, vehicle: MachineConfig, projection: Projection, config: LocalisationConfig, **more: Any) -> None:
        super().__init__(vehicle, projection, config, **more)
        self.dead_reckoning = DeadReckoning(vehicle, config.slip)
        self._vehicle = vehicle

    def run(self, readings: Iterable[Reading]) -> list[PoseBelief]:
        """Poses made or changed by readings; neighbours of one stamp come together."""
        poses: list[PoseBelief] = []
        for _, neighbours in groupby(readings, key=attrgetter("stamp_ns")):
            (group,) = by_stamp(neighbours)
            sensed = [(reading, self._vehicle.sensor(reading.sensor)) for reading in group]
            for reading, sensor in sensed:
                self.dead_reckoning.update(reading, sensor)
            poses += self.update(sensed, self.dead_reckoning)
        return poses

    def beliefs(self, readings: Iterable[Reading]) -> list[Belief]:
        """The newest beliefs after each stamp's readings."""
        beliefs: list[Belief] = []
        for _, group in groupby(readings, key=attrgetter("stamp_ns")):
            self.run(group)
            if self.belief and (not beliefs or self.belief.stamp_ns > beliefs[-1].stamp_ns):
                beliefs.append(self.belief)
        return beliefs


def localiser(vehicle: MachineConfig, step_s: float = STEP_S, **options: Any) -> RunLocaliser:
    """For a synthetic drive without wheel slip; the faster filter by default."""
    config = LocalisationConfig(**{"filter": "ekf", "slip": 0.0, "slip_soft": 0.0, **options})
    return RunLocaliser(vehicle, PROJECTION, config, step_s=step_s)
