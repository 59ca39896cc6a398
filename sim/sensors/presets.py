"""Presets: named sets of sensor errors and rates, like those of real sensors.

Standard deviations are per reading unless stated. Values and sources: `presets.toml`, the library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from protocol.config import from_table, require_between
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.site.site_config import NAME

LIBRARY = Path(__file__).parent / "presets.toml"
BASE_RATE_HZ = 100  # of the world; sensor rates divide it

SAME_NOISE = {"brake_force": "brake", "gps_velocity": "gps"}  # kinds whose errors stand in another table
BRAKE_READINGS = {"nothing": "", "switch": "brake", "share": "brake", "force": "brake_force"}  # reads -> kind

# Limits of values.
NotNegative = Annotated[float, (0.0, 1e6)]
Positive = Annotated[float, (0.01, 1e6)]
Share = Annotated[float, (0, 1)]
Scale = Annotated[float, (0, 0.5)]
Tilt = Annotated[float, (0, 45)]
Heading = Annotated[float, (0, 180)]


@dataclass(frozen=True)
class Ranged:
    """Values within the limits of their types."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            for low, high in getattr(hint, "__metadata__", ()):
                require_between(self, low, high, name)


@dataclass(frozen=True)
class SensorErrors(Ranged):
    """Errors and rate of one kind of sensor."""

    rate_hz: int

    def __post_init__(self) -> None:
        if self.rate_hz < 1 or BASE_RATE_HZ % self.rate_hz:
            raise ValueError(f"rate_hz: {self.rate_hz!r} does not divide {BASE_RATE_HZ}")
        super().__post_init__()


@dataclass(frozen=True)
class GpsNoise(SensorErrors):
    """Receiver: Gauss-Markov drift and white noise per horizontal axis; heights are 5/3 worse.

    scale: factor on both. machine_share: share of the drift's variance common to one machine's receivers; site_share:
    the part of it common to the site. Silent for outage_s of every outage_period_s. velocity_std_mps: Doppler, white,
    per axis.
    """

    drift_std_m: NotNegative
    drift_time_s: Positive
    white_std_m: NotNegative
    scale: NotNegative
    machine_share: Share
    site_share: Share
    outage_s: NotNegative
    outage_period_s: Positive
    velocity_std_mps: NotNegative

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.site_share > self.machine_share:
            raise ValueError(f"site_share: {self.site_share} is above machine_share, of which it is a part")
        if self.outage_s > self.outage_period_s:
            raise ValueError(f"outage_s: {self.outage_s} is longer than outage_period_s")


@dataclass(frozen=True)
class ImuNoise(SensorErrors):
    """IMU, per axis: white noise, turn-on bias, bias drift, scale error (of 1), mounting.

    force_vibration_mps2: added to the force's white noise while driving, in full from vibration_speed_mps. shake_mps2,
    wheel_mps2, engine_mps2: standard deviations of body vibration per axis: broad-band, wheel lugs, engine
    (`vibration`). degps_per_mps2: its angular rates.
    """

    gyro_white_degps: NotNegative
    gyro_turn_on_degps: NotNegative
    gyro_drift_degps: NotNegative
    force_white_mps2: NotNegative
    force_turn_on_mps2: NotNegative
    force_drift_mps2: NotNegative
    force_vibration_mps2: NotNegative
    vibration_speed_mps: Positive
    drift_time_s: Positive
    scale: Scale
    mounting_deg: Tilt
    shake_mps2: NotNegative = 0.0
    wheel_mps2: NotNegative = 0.0
    engine_mps2: NotNegative = 0.0
    degps_per_mps2: NotNegative = 0.0


@dataclass(frozen=True)
class AttitudeNoise(SensorErrors):
    """Attitude and heading reference: slow and white errors.

    heading_offset_deg: constant heading error, drawn once.
    """

    tilt_drift_deg: Tilt
    tilt_white_deg: Tilt
    heading_offset_deg: Heading
    heading_drift_deg: Heading
    heading_white_deg: Heading
    drift_time_s: Positive


@dataclass(frozen=True)
class EncoderNoise(SensorErrors):
    """Wheel encoders: whole ticks. Slip and true wheel radius are errors of the wheels."""

    ticks_per_rev: Annotated[int, (1, 1_000_000)]


@dataclass(frozen=True)
class TorqueNoise(SensorErrors):
    """Drive torque: white noise, correlated noise, scale error (of 1) drawn once.

    sees_brakes: whether braking is part of it; else service brakes act beside the drive train.
    """

    white_nm: NotNegative
    correlated_nm: NotNegative
    correlation_s: Positive
    scale: Scale
    sees_brakes: bool


@dataclass(frozen=True)
class BrakeNoise(SensorErrors):
    """Brakes. reads: `nothing`, a `switch`, the `share` of the maximum, or the `force` with white noise."""

    reads: str
    white_n: NotNegative

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reads not in BRAKE_READINGS:
            raise ValueError(f"reads: {self.reads!r} is none of {', '.join(BRAKE_READINGS)}")


@dataclass(frozen=True)
class ArticulationNoise(SensorErrors):
    """Joint angle: white noise, bias drawn once."""

    white_deg: Tilt
    zero_deg: Tilt


@dataclass(frozen=True)
class PayloadNoise(SensorErrors):
    """Weighing system: white noise, scale error (of 1) drawn once."""

    white_kg: NotNegative
    scale: Scale


@dataclass(frozen=True)
class BodySpread(Ranged):
    """Body tolerances: mass, uniform; wheel radius, standard deviation (of 1)."""

    mass: Scale
    wheel_radius: Annotated[float, (0, 0.1)]


@dataclass(frozen=True)
class Preset:
    """Errors of a machine's sensors by kind, and tolerances of its body."""

    name: str
    gps: GpsNoise
    imu: ImuNoise
    attitude: AttitudeNoise
    encoder: EncoderNoise
    torque: TorqueNoise
    articulation: ArticulationNoise
    payload: PayloadNoise
    brake: BrakeNoise
    body: BodySpread

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")

    def rate_hz(self, kind: str) -> int:
        """Rate of a kind of sensor."""
        return int(getattr(self, SAME_NOISE.get(kind, kind)).rate_hz)


@cache
def load_preset(name: str) -> Preset:
    """Load a preset of the library."""
    return parse_preset({"name": name, **_entry(name, "preset")}, f"{LIBRARY} [{name}]")


def parse_preset(table: Mapping[str, Any], where: str) -> Preset:
    """Build a preset from its TOML table; `base` names a library preset whose values it changes."""
    return from_table(Preset, _complete(table, where), where)


def _complete(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    own = {key: value for key, value in table.items() if key != "base"}
    if "base" not in table:
        return own
    whole = _complete(_entry(table["base"], f"{where} base"), where)
    for key, value in own.items():
        below = whole.get(key)
        whole[key] = {**below, **value} if isinstance(below, dict) and isinstance(value, dict) else value
    return whole


def _entry(name: Any, where: str) -> dict[str, Any]:
    library = _library()
    if not isinstance(name, str) or name not in library:
        raise ConfigError(where, f"there is no {name!r}; known: {', '.join(library)}")
    return library[name]


@cache
def _library() -> dict[str, dict[str, Any]]:
    return load_toml(LIBRARY)
