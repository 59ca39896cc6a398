"""Rigs and synthetic states for sensor tests; many machines give many draws."""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from protocol.site.site_config import Projection, SiteConfig
from protocol.units import GRAVITY_MPS2
from sim.machines.model import load_model
from sim.sensors.presets import GpsNoise, Preset, load_preset
from sim.sensors.rigs import Faults, Rig, machine_config
from sim.sensors.sensor_group import GroupReadings
from sim.sensors.sensors import FleetReadings, Sensors
from sim.state import FleetState

SEED = 7
LOADER = load_model("wheel_loader")
DGPS = load_preset("dgps")
PROJECTION = Projection(SiteConfig("pit", 49.0, 8.4, 110.0))
WIDTHS = {"rates_radps": 3, "rates_dot_radps2": 3, "force_mps2": 3, "wheel_radps": 2, "wheel_rad": 2}
KEPT = ("_time_s", "_period_s", "_speed_mps", "correlation_s")  # no errors, and nonzero


def perfect() -> Preset:
    """A preset without errors; tests switch single ones on."""
    return Preset("perfect", *(_quiet(getattr(DGPS, f.name)) for f in fields(Preset) if f.name != "name"))


def _quiet(noise: object) -> object:
    assert is_dataclass(noise)
    names = [f.name for f in fields(noise) if isinstance(getattr(noise, f.name), float) and not f.name.endswith(KEPT)]
    zeros = replace(noise, **dict.fromkeys(names, 0.0))
    return replace(zeros, scale=1.0) if isinstance(noise, GpsNoise) else zeros


def noisy(kind: str, **values: float) -> Preset:
    """The perfect preset with these errors of one kind."""
    preset = perfect()
    return replace(preset, **{kind: replace(getattr(preset, kind), **values)})


def rig(
    preset: Preset = DGPS,
    gps: Sequence[int] = (1,),
    imu: Sequence[int] = (3,),
    attitude: Sequence[int] = (),
    only: str | None = None,
    *,
    payload: bool = False,
    doppler: bool = False,
    faults: Faults = Faults(),  # noqa: B008 - frozen
) -> Rig:
    """A loader with these sensors. only: this kind alone."""
    numbers = tuple(gps), tuple(imu), tuple(attitude)
    machine = machine_config("loader", LOADER, preset, *numbers, payload=payload, doppler=doppler)
    kept = tuple(s for s in machine.sensors if only in (None, s.kind))
    return Rig(replace(machine, sensors=kept), LOADER, preset, faults)


def still(k: int, n: int = 1, **values: object) -> FleetState:
    """States (k, n, ...) at rest at the origin, except these values."""
    arrays = {f.name: (k, n, WIDTHS[f.name]) if f.name in WIDTHS else (k, n) for f in fields(FleetState)}
    given = {"force_mps2": (0.0, 0.0, GRAVITY_MPS2), **values}
    return FleetState(**{name: np.broadcast_to(given.get(name, 0.0), shape) for name, shape in arrays.items()})


def sampled(rigs: Sequence[Rig], states: FleetState, seed: int = SEED) -> FleetReadings:
    """Readings of states at 100 Hz."""
    steps = np.arange(1, len(states.x_m) + 1)
    return Sensors(rigs, seed, PROJECTION).sample(steps, steps * 10_000_000, states)


def groups(rigs: Sequence[Rig], states: FleetState, seed: int = SEED) -> dict[str, GroupReadings]:
    """The same by kind."""
    return {group.kind: group for group in sampled(rigs, states, seed).groups}


def values(one: Rig, kind: str, seconds: float, n: int = 1, **states: object) -> np.ndarray:
    """Readings (r, n, columns) of n machines with the same rig."""
    return groups([one] * n, still(round(100 * seconds), n, **states))[kind].values


def to_map(fixes: np.ndarray) -> np.ndarray:
    """Fixes (..., latitude, longitude, height, ...) in `map`, (..., 3)."""
    lat, lon, height = np.moveaxis(fixes[..., :3], -1, 0)
    x, y = PROJECTION._proj(lon.ravel(), lat.ravel())
    return np.stack([x.reshape(lat.shape), y.reshape(lat.shape), height - 110.0], axis=-1)


def errors(preset: Preset, kind: str, seconds: float, n: int, **states: object) -> np.ndarray:
    """Errors (r, n, columns) of level machines; fixes [m], attitudes as roll, pitch, heading [rad]."""
    truth = {"payload_kg": 4000.0, "torque_nm": 1e4, "yaw_rad": 0.0, **states}
    one = rig(preset, attitude=(3,), payload=True, only=kind)
    seen = values(one, kind, seconds, n, **truth)
    if kind == "gps":
        return to_map(seen) - [0.8, 0.0, 3.35]
    if kind == "attitude":
        x, y, z, w, *_ = np.moveaxis(seen, -1, 0)
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.stack([roll, np.arcsin(2 * (w * y - z * x)), heading], axis=-1)
    return seen - {"imu": [0, 0, 0, 0, 0, GRAVITY_MPS2], "torque": 1e4, "payload": 4000.0}.get(kind, 0.0)


def check_deviation(errors: np.ndarray, std: float, draws: int) -> None:
    """Check a standard deviation about 0. draws: independent ones; tolerance five standard errors."""
    assert math.sqrt((errors**2).mean()) == pytest.approx(std, rel=5 / math.sqrt(2 * draws)), f"seed {SEED}"


def check_correlation(errors: np.ndarray, lag: int, expected: float, draws: int) -> None:
    """Check the correlation of errors (r, ...) at a lag in rows. draws: as above."""
    correlation = (errors[lag:] * errors[:-lag]).mean() / (errors**2).mean()
    assert correlation == pytest.approx(expected, abs=5 / math.sqrt(draws)), f"seed {SEED}"
