"""The lanes of a site as an agent keeps them: metres driven by heading, in squares of 16 x 16 cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Floats, Ints
from protocol.queries.lanes import SCALE_M, SECTORS, LaneTile
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
        n = BLOCK_CELLS
        patch = np.zeros((len(sectors), north - south, east - west))
        around = np.stack([sectors - 1, sectors, sectors + 1]) % SECTORS
        for x in range(west // n, (east - 1) // n + 1):
            for y in range(south // n, (north - 1) // n + 1):
                if tile := self.tiles.get((x, y)):
                    before, own, after = METRES[tile.metres[around]]
                    square = (own + BESIDE * (before + after)).reshape(-1, n, n)
                    left, low = max(west, x * n), max(south, y * n)
                    right, high = min(east, (x + 1) * n), min(north, (y + 1) * n)
                    part = square[:, low - y * n : high - y * n, left - x * n : right - x * n]
                    patch[:, low - south : high - south, left - west : right - west] = part
        return patch


def sectors_of(heading_rad: Floats) -> Ints:
    """Sector of headings; the first one is centred on east."""
    sectors: NDArray[np.int64] = np.rint(heading_rad * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    return sectors
