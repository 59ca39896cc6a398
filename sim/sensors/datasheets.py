"""Parameters of all sensor models: their errors and how often they read, as presets set them.

Standard deviations are of one reading unless they say otherwise; `presets.toml` holds values and sources.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

BASE_RATE_HZ = 100  # of the world; sensors read at every so many of its steps

_STD, _TIME = (0.0, 1e6), (0.01, 1e6)


@dataclass(frozen=True)
class GpsNoise:
    """A receiver: slow Gauss-Markov drift and white noise per horizontal axis; heights are 5/3 worse.

    scale: multiplies drift and white noise alike. shared: share of the drift's variance that all receivers of the site
    have in common. The receiver is silent for outage_s of every outage_period_s.
    """

    rate_hz: int
    drift_std_m: float
    drift_time_s: float
    white_std_m: float
    scale: float
    shared: float
    outage_s: float
    outage_period_s: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, _STD, "drift_std_m", "white_std_m", "scale", "outage_s")
        _check(self, _TIME, "drift_time_s", "outage_period_s")
        _check(self, (0, 1), "shared")
        if self.outage_s > self.outage_period_s:
            raise ValueError(f"outage_s: {self.outage_s} is longer than outage_period_s")


@dataclass(frozen=True)
class ImuNoise:
    """An IMU, per axis: white noise, a zero that is drawn at turn-on, slow drift of it, scale (of 1), mounting.

    force_vibration_mps2: added to the white noise of the force while driving, in full from vibration_speed_mps on.
    """

    rate_hz: int
    gyro_white_degps: float
    gyro_turn_on_degps: float
    gyro_drift_degps: float
    force_white_mps2: float
    force_turn_on_mps2: float
    force_drift_mps2: float
    force_vibration_mps2: float
    vibration_speed_mps: float
    drift_time_s: float
    scale: float
    mounting_deg: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, _STD, "gyro_white_degps", "gyro_turn_on_degps", "gyro_drift_degps", "force_white_mps2")
        _check(self, _STD, "force_turn_on_mps2", "force_drift_mps2", "force_vibration_mps2")
        _check(self, _TIME, "vibration_speed_mps", "drift_time_s")
        _check(self, (0, 0.5), "scale")
        _check(self, (0, 45), "mounting_deg")


@dataclass(frozen=True)
class AttitudeNoise:
    """An attitude and heading reference: slow and white errors of roll, pitch and heading.

    heading_offset_deg: constant part of the heading's error, drawn once.
    """

    rate_hz: int
    tilt_drift_deg: float
    tilt_white_deg: float
    heading_offset_deg: float
    heading_drift_deg: float
    heading_white_deg: float
    drift_time_s: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, (0, 45), "tilt_drift_deg", "tilt_white_deg")
        _check(self, (0, 180), "heading_offset_deg", "heading_drift_deg", "heading_white_deg")
        _check(self, _TIME, "drift_time_s")


@dataclass(frozen=True)
class EncoderNoise:
    """Wheel encoders: whole ticks. Slip and the wheels' true radius are errors of the wheels, not of these."""

    rate_hz: int
    ticks_per_rev: int

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, (1, 1_000_000), "ticks_per_rev")


@dataclass(frozen=True)
class TorqueNoise:
    """Drive torque: white noise, noise correlated over correlation_s, and an error of the scale (of 1) drawn once."""

    rate_hz: int
    white_nm: float
    correlated_nm: float
    correlation_s: float
    scale: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, _STD, "white_nm", "correlated_nm")
        _check(self, _TIME, "correlation_s")
        _check(self, (0, 0.5), "scale")


@dataclass(frozen=True)
class ArticulationNoise:
    """Angle of the joint: white noise, and a zero that is drawn once."""

    rate_hz: int
    white_deg: float
    zero_deg: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, (0, 45), "white_deg", "zero_deg")


@dataclass(frozen=True)
class PayloadNoise:
    """A weighing system: white noise, and an error of the scale (of 1) drawn once."""

    rate_hz: int
    white_kg: float
    scale: float

    def __post_init__(self) -> None:
        _check_rate(self)
        _check(self, _STD, "white_kg")
        _check(self, (0, 0.5), "scale")


@dataclass(frozen=True)
class BodySpread:
    """How bodies differ from their nominal: mass, evenly up to this share; wheel radius, standard deviation (of 1)."""

    mass: float
    wheel_radius: float

    def __post_init__(self) -> None:
        _check(self, (0, 0.5), "mass")
        _check(self, (0, 0.1), "wheel_radius")


def _check(noise: Any, limits: tuple[float, float], *names: str) -> None:
    low, high = limits
    for name in names:
        value = getattr(noise, name)
        if not low <= value <= high:  # also false for NaN
            raise ValueError(f"{name}: {value!r} is not between {low:g} and {high:g}")


def _check_rate(noise: Any) -> None:
    if noise.rate_hz < 1 or BASE_RATE_HZ % noise.rate_hz:
        raise ValueError(f"rate_hz: {noise.rate_hz!r} does not divide {BASE_RATE_HZ}")
