"""True tracks of machines, from a simulation or a log's `evaluation.toml`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.wire.messages import Pose
from sitegrid.proof.figures import root_mean_square


@dataclass(frozen=True)
class Truth:
    """True track of `base_link`: stamps (n,), positions (n, 2) in `map` [m]."""

    stamp_ns: Ints
    position_m: Floats

    def at(self, stamp_ns: Ints) -> Floats:
        """True positions (m, 2); NaN outside the track's time."""
        return interpolate(stamp_ns, self.stamp_ns, self.position_m)


def interpolate(stamp_ns: Ints, known_ns: Ints, values: Floats) -> Floats:
    """Interpolate values (n,) or (n, k) at (n,) to other instants (m,); NaN outside."""
    t, known = (np.asarray(stamps - known_ns[0], float) * 1e-9 for stamps in (stamp_ns, known_ns))
    if values.ndim == 1:
        return np.interp(t, known, values, math.nan, math.nan)
    return np.stack([np.interp(t, known, column, math.nan, math.nan) for column in values.T], axis=-1)


def read_track(path: Path) -> Truth:
    """Read a simulation's `tracks/<machine>.csv`."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None)
    return Truth(table["stamp_ns"].astype(np.int64), np.stack([table["x"], table["y"]], axis=1))


@dataclass(frozen=True)
class LoadTrack:
    """True track of a load centre, n instants.

    stamp_ns: (n,). place_m: (n, 2) in `map`. yaw_rad: of the machine (n,), unwrapped. gradient: of the plane through
    its wheels, east and north (n, 2) [m/m]. driven_m: distance of the load centre so far (n,).
    """

    stamp_ns: Ints
    place_m: Floats
    yaw_rad: Floats
    gradient: Floats
    driven_m: Floats

    def at(self, stamp_ns: Ints) -> LoadTrack:
        """Interpolate to other instants (m,); NaN outside the track's time."""
        columns = (self.place_m, self.yaw_rad, self.gradient, self.driven_m)
        return LoadTrack(stamp_ns, *(interpolate(stamp_ns, self.stamp_ns, values) for values in columns))


def read_load_track(path: Path, load_centre_m: float) -> LoadTrack:
    """Read a simulation's `tracks/<machine>.csv`."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None)
    base, yaw = np.stack([table["x"], table["y"]], axis=-1), np.unwrap(table["yaw"])
    place = base + load_centre_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(place, axis=0).T))])
    gradient = np.stack([table["grade_e"], table["grade_n"]], axis=-1)
    return LoadTrack(table["stamp_ns"].astype(np.int64), place, yaw, gradient, driven)


def position_rmse(poses: Mapping[str, Sequence[Pose]], truth: Path) -> dict[str, float]:
    """Position RMSE [m] by machine; truth: a simulation's folder."""
    rmse = {}
    for name, track in poses.items():
        true = np.genfromtxt(truth / "tracks" / f"{name}.csv", delimiter=",", names=True)
        stamps = np.array([pose.stamp_ns for pose in track], np.float64)
        x, y = (np.interp(stamps, true["stamp_ns"], true[axis]) for axis in ("x", "y"))
        off = np.hypot(x - [pose.x_m for pose in track], y - [pose.y_m for pose in track])
        rmse[name] = root_mean_square(off)
    return rmse
