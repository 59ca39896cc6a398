"""What is true where a machine drove: the track of its load centre, and the soil, border and slope at any place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from evaluation.campaign.truth import interpolate
from evaluation.maps.score import border_distance
from protocol.arrays import Floats, Ints
from sim.scenario.ground import GroundConfig, build_terrain
from sim.terrain.terrain import Terrain
from sim.truth import TruthMap, truth_map

CELL_M = 1.0  # of the cells that are judged, as a site's map has them


@dataclass(frozen=True)
class LoadTrack:
    """True track of a machine's load centre, n instants.

    stamp_ns: (n,). place_m: (n, 2) in `map`. yaw_rad: of the machine (n,), without jumps. gradient: of the plane
    through its wheels, east and north (n, 2) [m/m]. driven_m: how far the load centre has moved so far (n,).
    """

    stamp_ns: Ints
    place_m: Floats
    yaw_rad: Floats
    gradient: Floats
    driven_m: Floats

    def at(self, stamp_ns: Ints) -> LoadTrack:
        """The same at other instants (m,); NaN before the first and after the last that is known."""
        columns = (self.place_m, self.yaw_rad, self.gradient, self.driven_m)
        return LoadTrack(stamp_ns, *(interpolate(stamp_ns, self.stamp_ns, values) for values in columns))


@dataclass(frozen=True)
class TrueGround:
    """True ground of a drive. terrain: as it is; profile: without its unevenness; truth: surveyed by cells."""

    terrain: Terrain
    profile: Terrain
    truth: TruthMap

    def zone(self, place_m: Floats) -> Ints:
        """Kind of ground (n,) at places (n, 2), as an index into `protocol.site.ground_classes.ZONES`."""
        return self.terrain.zone(place_m[:, 0], place_m[:, 1])

    def border_m(self, place_m: Floats) -> Floats:
        """How far places (n, 2) are from the nearest other kind of ground (n,)."""
        column, row = np.floor(place_m.T / self.terrain.zone_cell_m).astype(int)
        rows, columns = self._borders_m.shape
        distance: Floats = self._borders_m[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return distance

    def slope(self, place_m: Floats) -> Floats:
        """Gradient (n, 2) [m/m] of the ground without its unevenness."""
        return np.stack(self.profile.gradient(place_m[:, 0], place_m[:, 1]), axis=-1)

    def surveyed(self, column: Ints, row: Ints) -> Floats:
        """Gradient (n, 2) over cells, unevenness included."""
        rows, columns = self.truth.c_rr.shape
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        return np.stack([self.truth.grade_east[at], self.truth.grade_north[at]], axis=-1).astype(float)

    @cached_property
    def _borders_m(self) -> Floats:
        return border_distance(self.terrain.zones, self.terrain.zone_cell_m)


def true_ground(config: GroundConfig, seed: int, cell_m: float = CELL_M) -> TrueGround:
    """The ground that a simulation of this seed drives on."""
    terrain = build_terrain(config, seed)
    profile = build_terrain(replace(config, roughness_m=0.0), seed)
    return TrueGround(terrain, profile, truth_map(terrain, config.width_m, config.depth_m, cell_m))


def read_load_track(path: Path, load_centre_m: float) -> LoadTrack:
    """The truth that a simulation wrote: `tracks/<machine>.csv`."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None)
    base, yaw = np.stack([table["x"], table["y"]], axis=-1), np.unwrap(table["yaw"])
    place = base + load_centre_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(place, axis=0).T))])
    gradient = np.stack([table["grade_e"], table["grade_n"]], axis=-1)
    return LoadTrack(table["stamp_ns"].astype(np.int64), place, yaw, gradient, driven)
