"""Pure grid geometry: cells, blocks, bounds.

Cell (0, 0) has its south-west corner at the origin of `map`; columns grow east, rows north. 16 x 16 cells are a block,
the unit of memory.
"""

import math
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints

BLOCK_CELLS = 16
MAX_CELLS = 16_000_000  # per region query: 64 MB a layer
SLACK = 1e-9  # rounding tolerance in cells for bounds on an edge


@dataclass(frozen=True)
class Bounds:
    """A rectangle in `map` [m]: west <= x < east, south <= y < north."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    def __post_init__(self) -> None:
        values = (self.west_m, self.south_m, self.east_m, self.north_m)
        if not all(math.isfinite(v) for v in values):
            raise ValueError("bounds: not finite")
        if self.west_m >= self.east_m or self.south_m >= self.north_m:
            raise ValueError("bounds: west must be below east and south below north")

    def shared(self, other: "Bounds") -> "Bounds | None":
        """The common rectangle, or None."""
        west_m, south_m = max(self.west_m, other.west_m), max(self.south_m, other.south_m)
        east_m, north_m = min(self.east_m, other.east_m), min(self.north_m, other.north_m)
        return Bounds(west_m, south_m, east_m, north_m) if west_m < east_m and south_m < north_m else None


@dataclass(frozen=True)
class CellWindow:
    """Cells: first column and row, numbers of columns and rows."""

    column: int
    row: int
    columns: int
    rows: int


@dataclass(frozen=True)
class GridGeometry:
    """Positions to cells."""

    cell_m: float = 1.0

    def cell_of(self, position_m: Floats) -> Ints:
        """Column or row of positions on one axis."""
        return np.floor(position_m / self.cell_m).astype(np.int64)

    def window(self, bounds: Bounds) -> CellWindow:
        """Smallest window of cells around bounds."""
        column, row = (math.floor(v / self.cell_m + SLACK) for v in (bounds.west_m, bounds.south_m))
        end_column, end_row = (math.ceil(v / self.cell_m - SLACK) for v in (bounds.east_m, bounds.north_m))
        return CellWindow(column, row, max(1, end_column - column), max(1, end_row - row))

    def bounds(self, window: CellWindow) -> Bounds:
        """Outer edges [m]."""
        return Bounds(
            window.column * self.cell_m,
            window.row * self.cell_m,
            (window.column + window.columns) * self.cell_m,
            (window.row + window.rows) * self.cell_m,
        )

    def centres(self, first: int, count: int) -> Floats:
        """Centres [m] of `count` cells on one axis."""
        return (np.arange(first, first + count, dtype=np.float64) + 0.5) * self.cell_m
