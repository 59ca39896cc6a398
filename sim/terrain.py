"""The ground: height on a grid of nodes, bilinear in between, and the soil's zone on a grid of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints


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

    def height(self, x_m: Floats, y_m: Floats) -> Floats:
        """Height [m], bilinear."""
        a, b, (h00, h10, h01, h11) = self._patch(x_m, y_m)
        south, north = h00 + a * (h10 - h00), h01 + a * (h11 - h01)
        return south + b * (north - south)

    def gradient(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Gradient of the bilinear patch, east and north [m/m]."""
        a, b, (h00, h10, h01, h11) = self._patch(x_m, y_m)
        east = ((h10 - h00) * (1 - b) + (h11 - h01) * b) / self.cell_m
        north = ((h01 - h00) * (1 - a) + (h11 - h10) * a) / self.cell_m
        return east, north

    def zone(self, x_m: Floats, y_m: Floats) -> Ints:
        """Index into `soil.SOILS`."""
        rows, columns = self.zones.shape
        column = _index(x_m / self.zone_cell_m, columns - 1)
        row = _index(y_m / self.zone_cell_m, rows - 1)
        zone: Ints = self.zones[row, column]
        return zone

    def _patch(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats, tuple[Floats, ...]]:
        """Position within the patch (0..1 each way) and the heights of its four corners."""
        rows, columns = self.heights_m.shape
        u, v = x_m / self.cell_m, y_m / self.cell_m
        i, j = _index(u, columns - 2), _index(v, rows - 2)
        a, b = np.minimum(np.maximum(u - i, 0.0), 1.0), np.minimum(np.maximum(v - j, 0.0), 1.0)
        flat, k = self.heights_m.ravel(), j * columns + i
        return a, b, (flat[k], flat[k + 1], flat[k + columns], flat[k + columns + 1])


def _index(position: Floats, last: int) -> Ints:
    # numpy's clip costs five times these two on a handful of wheels
    index: Ints = np.minimum(np.maximum(position.astype(np.int64), 0), last)
    return index
