"""The ground: bilinear height on a grid, soil zones on cells (numba).

Its five materials are the paper's zones; traction and slip stiffness are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from protocol.arrays import Floats, Ints
from protocol.site.ground_classes import ZONES

_compiled = numba.njit(cache=True, inline="always", error_model="numpy")


class TerrainGrid(NamedTuple):
    """Arrays of a `Terrain` for compiled functions."""

    heights_m: Floats
    cell_m: float
    zones: Ints
    zone_cell_m: float


@dataclass(frozen=True)
class Terrain:
    """Ground of a site, south-west corner at the origin of `map`; edge values continue beyond.

    heights_m: (rows, columns) at nodes, rows northwards, `cell_m` apart. zones: (rows, columns) indices into
    `soil.SOILS`, per cell of `zone_cell_m`.
    """

    heights_m: Floats
    cell_m: float
    zones: Ints
    zone_cell_m: float

    @cached_property
    def grid(self) -> TerrainGrid:
        """As a tuple of arrays."""
        heights, zones = np.ascontiguousarray(self.heights_m, float), np.ascontiguousarray(self.zones, np.int64)
        return TerrainGrid(heights, float(self.cell_m), zones, float(self.zone_cell_m))

    def surface(self, x_m: Floats, y_m: Floats) -> Floats:
        """Bilinear height [m] and gradient east and north [m/m], as (3, ...)."""
        values: Floats = _surfaces(self.grid, x_m.ravel(), y_m.ravel())
        return values.reshape(3, *x_m.shape)

    def height(self, x_m: Floats, y_m: Floats) -> Floats:
        """Bilinear height [m]."""
        height: Floats = self.surface(x_m, y_m)[0]
        return height

    def gradient(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Gradient of the bilinear patch, east and north [m/m]."""
        _, east, north = self.surface(x_m, y_m)
        return east, north

    def zone(self, x_m: Floats, y_m: Floats) -> Ints:
        """Index into `soil.SOILS`."""
        indices: Ints = _zones(self.grid, x_m.ravel(), y_m.ravel())
        return indices.reshape(x_m.shape)


@_compiled
def surface(grid: TerrainGrid, x: float, y: float) -> tuple[float, float, float]:
    """Bilinear height and slopes east and north; edge values continue beyond."""
    heights, cell = grid.heights_m, grid.cell_m
    rows, columns = heights.shape
    u, v = x / cell, y / cell
    i, j = min(max(int(u), 0), columns - 2), min(max(int(v), 0), rows - 2)
    a, b = min(max(u - i, 0.0), 1.0), min(max(v - j, 0.0), 1.0)
    h00, h10, h01, h11 = heights[j, i], heights[j, i + 1], heights[j + 1, i], heights[j + 1, i + 1]
    south, north = h00 + a * (h10 - h00), h01 + a * (h11 - h01)
    east = (h10 - h00) * (1 - b) + (h11 - h01) * b
    return south + b * (north - south), east / cell, (north - south) / cell


@_compiled
def zone(grid: TerrainGrid, x: float, y: float) -> int:
    """Zone of the cell; edge values continue beyond."""
    rows, columns = grid.zones.shape
    row, column = int(y / grid.zone_cell_m), int(x / grid.zone_cell_m)
    index: int = grid.zones[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)]
    return index


@_compiled
def _surfaces(grid: TerrainGrid, x: Floats, y: Floats) -> Floats:
    """`surface` of places (k,), as (3, k)."""
    values = np.empty((3, x.size))
    for i in range(x.size):
        values[0, i], values[1, i], values[2, i] = surface(grid, x[i], y[i])
    return values


@_compiled
def _zones(grid: TerrainGrid, x: Floats, y: Floats) -> Ints:
    indices = np.empty(x.size, np.int64)
    for i in range(x.size):
        indices[i] = zone(grid, x[i], y[i])
    return indices


@dataclass(frozen=True)
class Soil:
    """One material [-]. traction: peak drive force over load. slip_stiffness: force over load per unit of slip."""

    name: str
    c_rr: float
    traction: float
    slip_stiffness: float


CONCRETE, GRAVEL, DRY_DIRT, WET_DIRT, SAND = range(5)

_GRIP = ((0.80, 15.0), (0.60, 9.0), (0.60, 7.0), (0.45, 5.0), (0.55, 3.0))
SOILS = tuple(Soil(zone.name, zone.c_rr, *grip) for zone, grip in zip(ZONES, _GRIP, strict=True))

# Columns of SOILS, indexed by arrays of zones.
C_RR = np.array([s.c_rr for s in SOILS])
TRACTION = np.array([s.traction for s in SOILS])
SLIP_STIFFNESS = np.array([s.slip_stiffness for s in SOILS])
