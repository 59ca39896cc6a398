"""Presets: named sets of sensor errors, like those of real sensors; `sim/sensors/presets.toml` is their library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.site.site_config import NAME
from sim.sensors.datasheets import (
    ArticulationNoise,
    AttitudeNoise,
    BodySpread,
    EncoderNoise,
    GpsNoise,
    ImuNoise,
    PayloadNoise,
    TorqueNoise,
)

LIBRARY = Path(__file__).parent / "presets.toml"


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
    body: BodySpread

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")

    def rate_hz(self, kind: str) -> int:
        """How often sensors of a kind read."""
        return int(getattr(self, kind).rate_hz)


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
