"""The lines along which machines drove, as single cells, tile by tile: a tile is made again only where it changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.timeline import Block, TimedPage, TimedPages, packed_votes
from mapserver.roads.ridges import AXES, Blur, add_axes, ridges
from mapserver.roads.thinning import REACH, thinned
from protocol.arrays import Ints
from protocol.site.geometry import BLOCK_CELLS

TILE_BLOCKS = 8
RASTER_M = 1.0  # smaller cells are joined to about this size: positions are not known any better
NEAR = 2  # cells to each side of a line whose metres are told beside it

Pages = Mapping[Block, Sequence[TimedPage]]
Tile = tuple[int, int]


@dataclass(frozen=True)
class Skeleton:
    """Cells of lines, sorted by row and column.

    places: (n, 2) row and column, in cells of raster_m from the origin. metres: (n, AXES) driven along each axis in the
    5 x 5 cells around, in 1/4096 m.
    """

    places: Ints
    metres: Ints
    raster_m: float


class Skeletons:
    """Makes skeletons of one map, and keeps the tiles whose pages are still the same objects.

    made: how many tiles so far. For one thread at a time.
    """

    def __init__(self, cell_m: float) -> None:
        self._join = max(1, int(RASTER_M / cell_m + 1e-9))
        self._raster_m = self._join * cell_m
        self._blur = Blur(self._raster_m)
        reach = (self._blur.reach + self._blur.side + REACH + NEAR + 1) * self._join
        self._margin = -(-reach // BLOCK_CELLS)  # blocks around a tile that it depends on
        self._tiles: dict[Tile, tuple[tuple[object, ...], Ints, Ints]] = {}
        self.made = 0

    def skeleton(self, pages: Pages) -> Skeleton:
        """The skeleton of a whole map."""
        wanted = {(x // TILE_BLOCKS, y // TILE_BLOCKS) for x, y in pages}
        self._tiles = {tile: kept for tile, kept in self._tiles.items() if tile in wanted}
        for tile in wanted:
            self._make(tile, pages)
        parts = [(places, metres) for _, places, metres in self._tiles.values()]
        places = np.concatenate([np.zeros((0, 2), np.int64), *(places for places, _ in parts)])
        metres = np.concatenate([np.zeros((0, AXES), np.int64), *(metres for _, metres in parts)])
        order = np.lexsort((places[:, 1], places[:, 0]))
        return Skeleton(places[order], metres[order], self._raster_m)

    def _make(self, tile: Tile, pages: Pages) -> None:
        first_x, first_y = (TILE_BLOCKS * index - self._margin for index in tile)
        count = TILE_BLOCKS + 2 * self._margin
        blocks = ((first_x + dx, first_y + dy) for dy in range(count) for dx in range(count))
        near = {block: pages[block] for block in blocks if block in pages}
        key: tuple[object, ...] = tuple(item for pair in near.items() for item in pair)
        kept = self._tiles.get(tile)
        if kept and len(kept[0]) == len(key) and all(map(_is_same, kept[0], key)):
            return
        self.made += 1
        n = count * BLOCK_CELLS
        cells = np.zeros((n, n, AXES), np.int64)
        for (x, y), block_pages in near.items():
            row, column = (y - first_y) * BLOCK_CELLS, (x - first_x) * BLOCK_CELLS
            at, metres = axis_metres(block_pages)
            cells[row + at[:, 0], column + at[:, 1], at[:, 2]] = metres
        axes, row, column = cells, first_y * BLOCK_CELLS, first_x * BLOCK_CELLS
        if self._join > 1:
            axes, row, column = _joined(axes, row, column, self._join)
        rows, columns = np.nonzero(thinned(ridges(axes, self._blur)))
        places = np.stack([rows + row, columns + column], axis=1)
        begin = np.array([tile[1], tile[0]]) * TILE_BLOCKS * BLOCK_CELLS
        own = ((places * self._join >= begin) & (places * self._join < begin + TILE_BLOCKS * BLOCK_CELLS)).all(axis=1)
        metres = _around(axes, rows[own], columns[own])
        self._tiles[tile] = key, places[own], metres


def axis_metres(pages: Sequence[TimedPage]) -> tuple[Ints, Ints]:
    """Where in a block machines drove: (n, 3) row, column and axis, and metres (n,) in 1/4096 m, of all pages."""
    if isinstance(pages, TimedPages) and axis_metres in pages.derived:
        known: tuple[Ints, Ints] = pages.derived[axis_metres]
        return known
    counts = np.zeros((ev.CELLS, AXES), np.int64)
    add_axes(packed_votes(pages)[0], ev.HEADING.start, ev.CELLS, counts)
    cells = counts.reshape(BLOCK_CELLS, BLOCK_CELLS, AXES)
    at = np.argwhere(cells)
    metres = at.astype(np.int16), cells[tuple(at.T)]
    if isinstance(pages, TimedPages):
        pages.derived[axis_metres] = metres  # few cells of a block are on a road
    return metres  # type: ignore[return-value]


def _is_same(one: object, other: object) -> bool:
    return one is other or (isinstance(one, tuple) and one == other)


def _joined(cells: Ints, row: int, column: int, join: int) -> tuple[Ints, int, int]:
    """Sum squares of cells whose numbers have the same quotient; also the first row and column of what comes out."""
    out, firsts = cells, []
    for axis, first in ((0, row), (1, column)):
        number = (first + np.arange(cells.shape[axis])) // join
        out = np.add.reduceat(out, np.flatnonzero(np.diff(number, prepend=number[0] - 1)), axis=axis)
        firsts.append(int(number[0]))
    return out, firsts[0], firsts[1]


def _around(axes: Ints, rows: Ints, columns: Ints) -> Ints:
    """Metres in the 5 x 5 cells around some cells, (n, AXES); these lie well inside."""
    steps = range(-NEAR, NEAR + 1)
    total = np.zeros((len(rows), AXES), np.int64)
    for dy in steps:
        for dx in steps:
            total += axes[rows + dy, columns + dx]
    return total
