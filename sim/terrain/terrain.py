"""The ground: height on a grid of nodes, bilinear in between, and the soil's zone on a grid of cells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from protocol.arrays import Floats, Ints
from sim.terrain import lookup


@dataclass(frozen=True)
class Terrain:
    """Ground of a site with its south-west corner at the origin of `map`; beyond the edges, the edge continues.

    heights_m: (rows, columns) at the nodes, rows to the north, `cell_m` apart. zones: (rows, columns) indices into
    `soil.SOILS`, one per cell of `zone_cell_m`.
    """

    heights_m: Floats
    cell_m: float
    zones: Ints
    zone_cell_m: float

    @cached_property
    def grid(self) -> lookup.TerrainGrid:
        """The same as a tuple of arrays, for kernels."""
        heights, zones = np.ascontiguousarray(self.heights_m, float), np.ascontiguousarray(self.zones, np.int64)
        return lookup.TerrainGrid(heights, float(self.cell_m), zones, float(self.zone_cell_m))

    def surface(self, x_m: Floats, y_m: Floats) -> Floats:
        """Height [m], bilinear, and its gradient to the east and north [m/m], as (3, ...)."""
        values: Floats = lookup.surfaces(self.grid, x_m.ravel(), y_m.ravel())
        return values.reshape(3, *x_m.shape)

    def height(self, x_m: Floats, y_m: Floats) -> Floats:
        """Height [m], bilinear."""
        height: Floats = self.surface(x_m, y_m)[0]
        return height

    def gradient(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Gradient of the bilinear patch, east and north [m/m]."""
        _, east, north = self.surface(x_m, y_m)
        return east, north

    def zone(self, x_m: Floats, y_m: Floats) -> Ints:
        """Index into `soil.SOILS`."""
        indices: Ints = lookup.zones(self.grid, x_m.ravel(), y_m.ravel())
        return indices.reshape(x_m.shape)
