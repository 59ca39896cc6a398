"""The lanes of a site as an agent keeps them: metres driven by heading, and slopes, in squares of 16 x 16 cells."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Floats, Ints
from protocol.queries.lanes import SCALE_M, SECTORS, SLOPE_CELLS, SLOPE_STEP, UNKNOWN_SLOPE, LaneTile
from protocol.site.geometry import BLOCK_CELLS
from protocol.units import DAY_NS

METRES = np.nan_to_num(SCALE_M.values())  # of all steps
BESIDE = 0.7  # how much a pass in a neighbouring sector of heading counts


@dataclass(frozen=True)
class LaneMap:
    """tiles: by column and row of the square. cell_m: size of a cell."""

    cell_m: float
    tiles: Mapping[tuple[int, int], LaneTile] = field(default_factory=dict)

    def is_young(self, stamp_ns: int) -> bool:
        """Whether all of it is of the day of a stamp."""
        day = stamp_ns // DAY_NS
        return all(tile.days < 2 and tile.newest_ns // DAY_NS == day for tile in self.tiles.values())

    def of_others(self, stamp_ns: int) -> LaneMap:
        """Without squares that one machine alone drew, on the day of a stamp: mostly this one, which errs as it did."""
        day = stamp_ns // DAY_NS
        tiles = {
            at: tile
            for at, tile in self.tiles.items()
            if tile.machines > 1 or tile.days > 1 or tile.newest_ns // DAY_NS != day
        }
        return LaneMap(self.cell_m, tiles)

    def patch(self, west: int, south: int, east: int, north: int, sectors: Ints) -> Floats:
        """Metres driven (sectors, rows, columns) in a rectangle of cells, up to before east and north.

        sectors (k,): of heading; what was driven in those beside them counts less. 0 where nobody drove.
        """
        patch = np.zeros((len(sectors), north - south, east - west))
        around = np.stack([sectors - 1, sectors, sectors + 1]) % SECTORS
        for tile, there, here in self._parts(west, south, east, north, BLOCK_CELLS):
            before, own, after = METRES[tile.metres[around]].reshape(3, -1, BLOCK_CELLS, BLOCK_CELLS)[:, :, *here]
            patch[:, *there] = own + BESIDE * (before + after)
        return patch

    def gradient(self, x_m: Floats, y_m: Floats) -> Floats:
        """Gradient of the ground (2, ...) at places (...), between the four parts around; NaN where none is known.

        Unknown parts are left out of the mean, unless they have more than half of its weight.
        """
        side, edge_m = BLOCK_CELLS // SLOPE_CELLS, SLOPE_CELLS * self.cell_m
        x, y = x_m / edge_m - 0.5, y_m / edge_m - 0.5  # of centres
        west, south = math.floor(x.min()), math.floor(y.min())
        east, north = math.floor(x.max()) + 2, math.floor(y.max()) + 2
        steps = np.full((2, north - south, east - west), UNKNOWN_SLOPE, np.int8)
        for tile, there, here in self._parts(west, south, east, north, side):
            steps[:, *there] = tile.slopes.reshape(2, side, side)[:, *here]
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        total, weight = np.zeros((2, *x.shape)), np.zeros(x.shape)
        for right, up in ((0, 0), (0, 1), (1, 0), (1, 1)):
            part = steps[:, row + up - south, column + right - west]
            share = np.abs(1 - right - x + column) * np.abs(1 - up - y + row) * (part[0] != UNKNOWN_SLOPE)
            total, weight = total + part * share, weight + share
        return np.where(weight >= 0.5, SLOPE_STEP * total / np.maximum(weight, 0.5), np.nan)

    def _parts(
        self, west: int, south: int, east: int, north: int, n: int
    ) -> Iterator[tuple[LaneTile, tuple[slice, slice], tuple[slice, slice]]]:
        """Squares of n x n values that a rectangle meets: with rows and columns in it, and in the square."""
        for x in range(west // n, (east - 1) // n + 1):
            for y in range(south // n, (north - 1) // n + 1):
                if tile := self.tiles.get((x, y)):
                    left, low = max(west, x * n), max(south, y * n)
                    right, high = min(east, (x + 1) * n), min(north, (y + 1) * n)
                    there = slice(low - south, high - south), slice(left - west, right - west)
                    yield tile, there, (slice(low - y * n, high - y * n), slice(left - x * n, right - x * n))


def sectors_of(heading_rad: Floats) -> Ints:
    """Sector of headings; the first one is centred on east."""
    sectors: NDArray[np.int64] = np.rint(heading_rad * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    return sectors
