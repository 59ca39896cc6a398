"""Presets: errors of all sensor models and how often they read, in named sets like those of real sensors.

Standard deviations are of one reading unless they say otherwise; `presets.toml`, the library, holds values and sources.
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
BASE_RATE_HZ = 100  # of the world; sensors read at every so many of its steps

SAME_NOISE = {"brake_force": "brake", "gps_velocity": "gps"}  # kinds whose errors stand in the table of another
BRAKE_READINGS = {"nothing": "", "switch": "brake", "share": "brake", "force": "brake_force"}  # and their kinds

# What values may be, lowest and highest.
NotNegative = Annotated[float, (0.0, 1e6)]
Positive = Annotated[float, (0.01, 1e6)]
Share = Annotated[float, (0, 1)]
Scale = Annotated[float, (0, 0.5)]
Tilt = Annotated[float, (0, 45)]
Heading = Annotated[float, (0, 180)]


@dataclass(frozen=True)
class Ranged:
    """Values that lie in the ranges of their types."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            for low, high in getattr(hint, "__metadata__", ()):
                require_between(self, low, high, name)


@dataclass(frozen=True)
class SensorErrors(Ranged):
    """Errors of one kind of sensor, and how often it reads."""

    rate_hz: int

    def __post_init__(self) -> None:
        if self.rate_hz < 1 or BASE_RATE_HZ % self.rate_hz:
            raise ValueError(f"rate_hz: {self.rate_hz!r} does not divide {BASE_RATE_HZ}")
        super().__post_init__()


@dataclass(frozen=True)
class GpsNoise(SensorErrors):
    """A receiver: slow Gauss-Markov drift and white noise per horizontal axis; heights are 5/3 worse.

    scale: multiplies drift and white noise alike. machine_share: share of the drift's variance that the receivers of
    one machine have in common; site_share: the part of it that all receivers of the site have in common. The receiver
    is silent for outage_s of every outage_period_s. velocity_std_mps: of its Doppler velocity, white, per axis.
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
    """An IMU, per axis: white noise, a zero that is drawn at turn-on, slow drift of it, scale (of 1), mounting.

    force_vibration_mps2: added to the white noise of the force while driving, in full from vibration_speed_mps on.
    shake_mps2, wheel_mps2, engine_mps2: standard deviations of how the body itself shakes, per axis: broad-band, with
    the lugs of the wheels, and with the engine (`vibration`). degps_per_mps2: the rates that go with them.
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
    """An attitude and heading reference: slow and white errors of roll, pitch and heading.

    heading_offset_deg: constant part of the heading's error, drawn once.
    """

    tilt_drift_deg: Tilt
    tilt_white_deg: Tilt
    heading_offset_deg: Heading
    heading_drift_deg: Heading
    heading_white_deg: Heading
    drift_time_s: Positive


@dataclass(frozen=True)
class EncoderNoise(SensorErrors):
    """Wheel encoders: whole ticks. Slip and the wheels' true radius are errors of the wheels, not of these."""

    ticks_per_rev: Annotated[int, (1, 1_000_000)]


@dataclass(frozen=True)
class TorqueNoise(SensorErrors):
    """Drive torque: white noise, noise correlated over correlation_s, and an error of the scale (of 1) drawn once.

    sees_brakes: whether what brakes the machine is in it; else service brakes do it, beside the drive train.
    """

    white_nm: NotNegative
    correlated_nm: NotNegative
    correlation_s: Positive
    scale: Scale
    sees_brakes: bool


@dataclass(frozen=True)
class BrakeNoise(SensorErrors):
    """Brakes. reads: `nothing` of them, a `switch`, the `share` of their most, or their `force` with white noise."""

    reads: str
    white_n: NotNegative

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reads not in BRAKE_READINGS:
            raise ValueError(f"reads: {self.reads!r} is none of {', '.join(BRAKE_READINGS)}")


@dataclass(frozen=True)
class ArticulationNoise(SensorErrors):
    """Angle of the joint: white noise, and a zero that is drawn once."""

    white_deg: Tilt
    zero_deg: Tilt


@dataclass(frozen=True)
class PayloadNoise(SensorErrors):
    """A weighing system: white noise, and an error of the scale (of 1) drawn once."""

    white_kg: NotNegative
    scale: Scale


@dataclass(frozen=True)
class BodySpread(Ranged):
    """How bodies differ from their nominal: mass, evenly up to this share; wheel radius, standard deviation (of 1)."""

    mass: Scale
    wheel_radius: Annotated[float, (0, 0.1)]


@dataclass(frozen=True)
class Preset:
    """Errors of all sensors of a machine, by their kind, and how far its body is from nominal."""

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
        """How often sensors of a kind read."""
        return int(getattr(self, SAME_NOISE.get(kind, kind)).rate_hz)


@cache
def load_preset(name: str) -> Preset:
    """Read a preset of the library."""
    return parse_preset({"name": name, **_entry(name, "preset")}, f"{LIBRARY} [{name}]")


def parse_preset(table: Mapping[str, Any], where: str) -> Preset:
    """Build a preset from its TOML table. `base` names a preset of the library, of which the table changes values."""
    return from_table(Preset, _complete(table, where), where)


def _complete(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Merge a table over its base, section by section."""
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
