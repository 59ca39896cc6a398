"""What an agent knows of its machine: the body's nominal dimensions and the sensors with their mounting."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from protocol.arrays import Floats
from protocol.readings import KINDS
from protocol.site import NAME


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits: its origin in `base_link` [m] and roll, pitch, yaw [deg] of `base_from_sensor`."""

    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def base_from_sensor(self) -> Floats:
        """Return the rotation matrix (3, 3) that turns vectors of the sensor into `base_link` (yaw @ pitch @ roll)."""
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in np.radians(self.rpy_deg))
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


@dataclass(frozen=True)
class SensorConfig:
    """One sensor of a machine.

    name: as readings carry it. drift_std_m, drift_time_s: size and correlation time of the slow error of a GPS
    receiver. ticks_per_rev: of an encoder. use: false leaves the sensor's readings aside.
    """

    name: str
    kind: str
    mount: Mount = field(default_factory=Mount)
    use: bool = True
    drift_std_m: float = 1.7
    drift_time_s: float = 45.0
    ticks_per_rev: int = 100

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if self.kind not in KINDS:
            raise ValueError(f"kind: {self.kind!r} is none of {', '.join(KINDS)}")
        if self.drift_std_m < 0 or self.drift_time_s <= 0 or self.ticks_per_rev <= 0:
            raise ValueError("drift_std_m must not be negative; drift_time_s and ticks_per_rev must be positive")


@dataclass(frozen=True)
class MachineConfig:
    """Nominal body of a machine; `base_link` is its rear frame, on the ground below the rear axle's centre.

    load_centre_m: how far ahead of `base_link` the wheel loads' centre lies. rotating_mass_factor: mass plus the
    wheels' inertia over mass. A machine without a drive torque sensor needs no mass.
    """

    name: str
    mass_kg: float = 17_500.0
    wheel_radius_m: float = 0.75
    wheelbase_m: float = 3.3
    track_m: float = 2.2
    load_centre_m: float = 1.5
    rotating_mass_factor: float = 1.07
    sensors: tuple[SensorConfig, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if min(self.mass_kg, self.wheel_radius_m, self.wheelbase_m, self.track_m) <= 0:
            raise ValueError("mass_kg, wheel_radius_m, wheelbase_m and track_m must be positive")
        if self.rotating_mass_factor < 1:
            raise ValueError("rotating_mass_factor: below 1")
        names = [s.name for s in self.sensors]
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"sensors: two are named {twice[0]!r}")

    def sensor(self, name: str) -> SensorConfig | None:
        """The sensor of that name."""
        return next((s for s in self.sensors if s.name == name), None)
