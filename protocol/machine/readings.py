"""Sensor readings: an agent's only input, from simulation, replay or drivers.

Each kind is a flat frozen dataclass; its fields are the columns of log folders and bundles, with units as suffixes.
Values are raw, in the sensor's frame.
"""

import math
from dataclasses import dataclass, fields
from typing import ClassVar

from protocol.errors import MessageError, Refusal

MAX_STAMP_NS = 4_102_444_800_000_000_000  # year 2100


@dataclass(frozen=True, slots=True)
class Reading:
    """A sensor reading. stamp_ns: UTC nanoseconds at which the quantity was true."""

    kind: ClassVar[str] = ""
    limits: ClassVar[dict[str, tuple[float, float]]] = {}

    sensor: str
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Gps(Reading):
    """An antenna's fix, WGS 84, with stated variances."""

    kind: ClassVar[str] = "gps"
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        "lat_deg": (-90, 90),
        "lon_deg": (-180, 180),
        "height_m": (-1e4, 1e5),
        **dict.fromkeys(("var_e_m2", "var_n_m2", "var_u_m2"), (1e-8, 1e6)),
    }

    lat_deg: float
    lon_deg: float
    height_m: float
    var_e_m2: float
    var_n_m2: float
    var_u_m2: float


@dataclass(frozen=True, slots=True)
class GpsVelocity(Reading):
    """Doppler velocity of an antenna east and north, with stated variances."""

    kind: ClassVar[str] = "gps_velocity"
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("velocity_e_mps", "velocity_n_mps"), (-100.0, 100.0)),
        **dict.fromkeys(("var_e_m2ps2", "var_n_m2ps2"), (1e-8, 1e4)),
    }

    velocity_e_mps: float
    velocity_n_mps: float
    var_e_m2ps2: float
    var_n_m2ps2: float


@dataclass(frozen=True, slots=True)
class Imu(Reading):
    """Angular rate and specific force (+9.8 on the upward axis at rest)."""

    kind: ClassVar[str] = "imu"
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("gyro_x_radps", "gyro_y_radps", "gyro_z_radps"), (-50.0, 50.0)),
        **dict.fromkeys(("force_x_mps2", "force_y_mps2", "force_z_mps2"), (-500.0, 500.0)),
    }

    gyro_x_radps: float
    gyro_y_radps: float
    gyro_z_radps: float
    force_x_mps2: float
    force_y_mps2: float
    force_z_mps2: float


@dataclass(frozen=True, slots=True)
class Attitude(Reading):
    """Orientation `map_from_sensor` of a reference, as a unit quaternion."""

    kind: ClassVar[str] = "attitude"
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("qx", "qy", "qz", "qw"), (-1.001, 1.001)),
        **dict.fromkeys(("var_roll_rad2", "var_pitch_rad2", "var_yaw_rad2"), (1e-12, 100.0)),
    }

    qx: float
    qy: float
    qz: float
    qw: float
    var_roll_rad2: float
    var_pitch_rad2: float
    var_yaw_rad2: float


@dataclass(frozen=True, slots=True)
class Odometry(Reading):
    """Velocity of the machine's frame by its controller."""

    kind: ClassVar[str] = "odometry"
    limits: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("speed_x_mps", "speed_y_mps"), (-100, 100)),
        "rate_z_radps": (-50, 50),
    }

    speed_x_mps: float
    speed_y_mps: float
    rate_z_radps: float


@dataclass(frozen=True, slots=True)
class Encoder(Reading):
    """Tick counts of an axle's two wheels, down in reverse."""

    kind: ClassVar[str] = "encoder"
    limits: ClassVar[dict[str, tuple[float, float]]] = dict.fromkeys(("left_ticks", "right_ticks"), (-1e15, 1e15))

    left_ticks: float
    right_ticks: float


WheelReading = Encoder | Odometry  # sensors of wheel roll


@dataclass(frozen=True, slots=True)
class Torque(Reading):
    """Drive torque at all wheels, positive forwards."""

    kind: ClassVar[str] = "torque"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"torque_nm": (-1e7, 1e7)}

    torque_nm: float


@dataclass(frozen=True, slots=True)
class Engine(Reading):
    """Indicated engine torque, friction included, as a share of the reference torque, and speed."""

    kind: ClassVar[str] = "engine"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"torque": (-1.25, 1.5), "speed_radps": (0, 1000)}

    torque: float
    speed_radps: float


@dataclass(frozen=True, slots=True)
class EngineLosses(Reading):
    """Engine friction and auxiliary drives, as a share of the reference torque."""

    kind: ClassVar[str] = "engine_losses"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"friction": (-1.25, 1.5)}

    friction: float


@dataclass(frozen=True, slots=True)
class FuelRate(Reading):
    """Diesel per hour."""

    kind: ClassVar[str] = "fuel_rate"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"litres_ph": (0, 3300)}

    litres_ph: float


@dataclass(frozen=True, slots=True)
class Driveline(Reading):
    """Clutch closed, converter locked, gear changing: 0 or 1 each."""

    kind: ClassVar[str] = "driveline"
    limits: ClassVar[dict[str, tuple[float, float]]] = dict.fromkeys(("engaged", "locked", "shifting"), (0.0, 1.0))

    engaged: float
    locked: float
    shifting: float


@dataclass(frozen=True, slots=True)
class Motor(Reading):
    """Shaft torque of electric or hydraulic motors, summed, positive forwards."""

    kind: ClassVar[str] = "motor"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"torque_nm": (-1e6, 1e6)}

    torque_nm: float


@dataclass(frozen=True, slots=True)
class MotorPower(Reading):
    """Mechanical power of drive motors, negative in braking."""

    kind: ClassVar[str] = "motor_power"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"power_w": (-1e7, 1e7)}

    power_w: float


@dataclass(frozen=True, slots=True)
class HydraulicPressure(Reading):
    """Pressure of hydraulics that the engine drives beside the wheels."""

    kind: ClassVar[str] = "hydraulic_pressure"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"pressure_pa": (-1e6, 2e8)}

    pressure_pa: float


@dataclass(frozen=True, slots=True)
class Retarder(Reading):
    """Torque of a retarder as a share of its reference torque."""

    kind: ClassVar[str] = "retarder"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"torque": (0, 1.25)}

    torque: float


@dataclass(frozen=True, slots=True)
class Brake(Reading):
    """Applied share of a brake, unseen by the torque; 0 or 1 of a switch."""

    kind: ClassVar[str] = "brake"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"applied": (0, 1)}

    applied: float


@dataclass(frozen=True, slots=True)
class BrakeForce(Reading):
    """Brake or retarder force at the wheels, unseen by the torque, in any direction of travel."""

    kind: ClassVar[str] = "brake_force"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"force_n": (0, 1e7)}

    force_n: float


@dataclass(frozen=True, slots=True)
class Articulation(Reading):
    """Angle of front against rear frame, positive left."""

    kind: ClassVar[str] = "articulation"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"angle_rad": (-math.pi, math.pi)}

    angle_rad: float


@dataclass(frozen=True, slots=True)
class Payload(Reading):
    """Load by the weighing system."""

    kind: ClassVar[str] = "payload"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"payload_kg": (0, 500_000)}

    payload_kg: float


@dataclass(frozen=True, slots=True)
class Steering(Reading):
    """Angle of a front wheel in the middle, positive left."""

    kind: ClassVar[str] = "steering"
    limits: ClassVar[dict[str, tuple[float, float]]] = {"angle_rad": (-1.5, 1.5)}  # across there is no turn rate

    angle_rad: float


KINDS: dict[str, type[Reading]] = {
    cls.kind: cls
    for cls in (
        Gps,
        GpsVelocity,
        Imu,
        Attitude,
        Odometry,
        Encoder,
        Torque,
        Engine,
        EngineLosses,
        FuelRate,
        Driveline,
        Motor,
        MotorPower,
        HydraulicPressure,
        Retarder,
        Brake,
        BrakeForce,
        Articulation,
        Steering,
        Payload,
    )
}


def columns(kind: str) -> tuple[str, ...]:
    """Value columns of a kind, in field order."""
    return tuple(f.name for f in fields(KINDS[kind]))[2:]


def parse_reading(kind: str, sensor: str, stamp_ns: int, values: tuple[float, ...]) -> Reading:
    """Build a reading; MessageError names the first value not finite or out of range."""
    cls = KINDS[kind]
    if not 0 < stamp_ns <= MAX_STAMP_NS:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{stamp_ns} is not a UTC stamp in ns", field=f"{sensor}.stamp_ns")
    for (name, (low, high)), value in zip(cls.limits.items(), values, strict=True):
        if not low <= value <= high:  # also false for NaN
            reason = Refusal.OUT_OF_RANGE if math.isfinite(value) else Refusal.NOT_FINITE
            raise MessageError(reason, f"{value!r} is not between {low:g} and {high:g}", field=f"{sensor}.{name}")
    return cls(sensor, stamp_ns, *values)
