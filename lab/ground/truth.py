"""Truth of a drive: load centre track; soil, border and slope anywhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from protocol.arrays import Floats, Ints
from sim.scenario.ground import GroundConfig, build_terrain
from sim.terrain.terrain import Terrain
from sim.truth import TruthMap, truth_map
from sitegrid.proof.map_score import border_distance

CELL_M = 1.0  # of judged cells, as on a site's map


@dataclass(frozen=True)
class TrueGround:
    """True ground. terrain: with roughness; profile: without; truth: by cell."""

    terrain: Terrain
    profile: Terrain
    truth: TruthMap

    def zone(self, place_m: Floats) -> Ints:
        """Class (n,) at places (n, 2), an index into `protocol.site.ground_classes.ZONES`."""
        return self.terrain.zone(place_m[:, 0], place_m[:, 1])

    def border_m(self, place_m: Floats) -> Floats:
        """Distance (n,) of places (n, 2) from the nearest other class."""
        column, row = np.floor(place_m.T / self.terrain.zone_cell_m).astype(int)
        rows, columns = self._borders_m.shape
        distance: Floats = self._borders_m[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return distance

    def slope(self, place_m: Floats) -> Floats:
        """Gradient (n, 2) [m/m] without roughness."""
        return np.stack(self.profile.gradient(place_m[:, 0], place_m[:, 1]), axis=-1)

    def surveyed(self, column: Ints, row: Ints) -> Floats:
        """Gradient (n, 2) of cells with roughness."""
        rows, columns = self.truth.c_rr.shape
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        return np.stack([self.truth.grade_east[at], self.truth.grade_north[at]], axis=-1).astype(float)

    @cached_property
    def _borders_m(self) -> Floats:
        return border_distance(self.terrain.zones, self.terrain.zone_cell_m)


def true_ground(config: GroundConfig, seed: int, cell_m: float = CELL_M) -> TrueGround:
    """The ground of a simulation with this seed."""
    terrain = build_terrain(config, seed)
    profile = build_terrain(replace(config, roughness_m=0.0), seed)
    return TrueGround(terrain, profile, truth_map(terrain, config.width_m, config.depth_m, cell_m))
