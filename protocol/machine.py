"""What an agent knows of its machine: the body's nominal dimensions and the sensors with their mounting."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.readings import KINDS
from protocol.site import NAME

BASE, FRONT = "base_link", "front_link"
# What readings of a kind say, by name, where a sensor may give a part of it: an IMU without an accelerometer, an
# orientation whose heading is of no use.
GIVES = {"imu": ("rate", "force"), "attitude": ("tilt", "heading")}


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits: its origin in its frame [m] and roll, pitch, yaw [deg] of `frame_from_sensor`."""

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

    name: as readings carry it. use: false leaves the sensor's readings aside. gives: what of its readings is meant, by
    the names in GIVES; empty: all. delay_s: how much later than it was true a reading is stamped. gate_sigma: refused
    if further off than so many standard deviations; 0: as the filter's options say. frame: which frame of an
    articulated machine carries it; `front_link` starts at the joint, at the height of the wheels' hubs. drift_share,
    drift_time_s: of a GPS receiver, the share of its stated variance that is a slow error, and that error's
    correlation time. ticks_per_rev: of an encoder.
    """

    name: str
    kind: str
    mount: Mount = field(default_factory=Mount)
    use: bool = True
    gives: tuple[str, ...] = ()
    delay_s: float = 0.0
    gate_sigma: float = 0.0
    frame: str = BASE
    drift_share: float = 0.75
    drift_time_s: float = 45.0
    ticks_per_rev: int = 100

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if self.kind not in KINDS:
            raise ValueError(f"kind: {self.kind!r} is none of {', '.join(KINDS)}")
        if unknown := sorted(set(self.gives) - set(GIVES.get(self.kind, ()))):
            raise ValueError(f"gives: {self.kind} has no {unknown[0]!r}, but {', '.join(GIVES.get(self.kind, ()))}")
        if self.frame not in (BASE, FRONT):
            raise ValueError(f"frame: {self.frame!r} is neither {BASE} nor {FRONT}")
        if not (0 <= self.delay_s <= 10 and 0 <= self.gate_sigma <= 1000):
            raise ValueError("delay_s must be between 0 and 10, gate_sigma between 0 and 1000")
        if not 0 <= self.drift_share <= 1:
            raise ValueError(f"drift_share: {self.drift_share} is not between 0 and 1")
        if self.drift_time_s <= 0 or self.ticks_per_rev <= 0:
            raise ValueError("drift_time_s and ticks_per_rev must be positive")

    def says(self, name: str) -> bool:
        """Whether its readings mean this, one of GIVES."""
        return not self.gives or name in self.gives


@dataclass(frozen=True)
class MachineConfig:
    """Nominal body of a machine; `base_link` is its rear frame, on the ground below the rear axle's centre.

    load_centre_m: how far ahead of `base_link` the wheel loads' centre lies. rotating_mass_factor: mass plus the
    wheels' inertia over mass. A machine without a drive torque sensor needs no mass.
    """

    name: str
    mass_kg: float = 17_500.0
    wheel_radius_m: float = 0.75
    load_centre_m: float = 1.5
    rotating_mass_factor: float = 1.07
    sensors: tuple[SensorConfig, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if min(self.mass_kg, self.wheel_radius_m) <= 0:
            raise ValueError("mass_kg and wheel_radius_m must be positive")
        if self.rotating_mass_factor < 1:
            raise ValueError("rotating_mass_factor: below 1")
        names = [s.name for s in self.sensors]
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"sensors: two are named {twice[0]!r}")

    def sensor(self, name: str) -> SensorConfig | None:
        """The sensor of that name."""
        return next((s for s in self.sensors if s.name == name), None)


def parse_machine(table: Mapping[str, Any], sensors: tuple[SensorConfig, ...], where: str) -> MachineConfig:
    """Build a machine from its TOML table and its sensors."""
    try:
        return replace(from_table(MachineConfig, table, f"{where} [machine]"), sensors=sensors)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None


def sensor_lines(sensor: SensorConfig) -> list[str]:
    """The keys of one sensor as TOML."""
    xyz_m, rpy_deg = ([float(v) for v in values] for values in (sensor.mount.xyz_m, sensor.mount.rpy_deg))
    return [*plain_lines(sensor), f"mount = {{ xyz_m = {xyz_m}, rpy_deg = {rpy_deg} }}"]


def machine_toml(machine: MachineConfig) -> str:
    """A machine and its sensors as TOML, as an agent's configuration has them."""
    lines = ["[machine]", *plain_lines(machine)]
    for sensor in machine.sensors:
        lines += ["", "[[sensor]]", *sensor_lines(sensor)]
    return "\n".join(lines) + "\n"


def plain_lines(config: Any) -> list[str]:
    """The plain values of a dataclass as TOML keys."""
    values = {f.name: getattr(config, f.name) for f in fields(config)}
    plain = {name: value for name, value in values.items() if isinstance(value, bool | int | float | str)}
    names = {name: list(value) for name, value in values.items() if name == "gives"}
    return [f"{name} = {json.dumps(value)}" for name, value in {**plain, **names}.items()]
