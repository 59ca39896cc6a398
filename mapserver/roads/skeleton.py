"""Centre lines of driven roads as single cells; only changed tiles are recomputed.

A tile's ridges depend on nearby evidence, its lines on the ridges of 3 x 3 tiles. More passes rarely move ridges.
Thinning keeps the topology (8-connected): algorithm A1 of Guo and Hall, "Parallel thinning with two-subiteration
algorithms", Communications of the ACM 32 (1989). A fixed number of rounds limits its reach to `REACH` cells; wider
areas stay thick.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, HEADING
from mapserver.evidence.grid import READ_BLOCKS
from mapserver.evidence.timeline import Block, TimedPages, plane_counts
from mapserver.roads.ridges import AXES, Blur, ridges
from protocol.arrays import AnyArray, Bools, Ints
from protocol.site.geometry import BLOCK_CELLS

ROUNDS = 8  # rounds of thinning: ridges are five cells wide, crossings more
REACH = 2 * ROUNDS + 1


def thinned(mask: Bools) -> Bools:
    """Lines (rows, columns) of a mask, empty outside. Holes of one cell are closed first, or they become rings."""
    padded = np.pad(mask, 1).astype(np.uint8)
    _close_holes(padded)
    _thin(padded)
    return np.asarray(padded[1:-1, 1:-1], np.bool_)


@numba.njit(cache=True, nogil=True)
def _close_holes(image: Any) -> None:
    rows, columns = image.shape
    before = image.copy()
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            if before[y - 1, x] and before[y + 1, x] and before[y, x - 1] and before[y, x + 1]:
                image[y, x] = 1


@numba.njit(cache=True, nogil=True)
def _thin(image: Any) -> None:
    places = np.argwhere(image)
    removed = np.empty(len(places), np.int64)
    last = 0  # last subiteration that removed cells
    for turn in range(2 * ROUNDS):
        gone = 0
        for i in range(len(places)):
            y, x = places[i]
            if image[y, x] and _is_removable(image, y, x, turn % 2):
                removed[gone] = i
                gone += 1
        for k in range(gone):
            y, x = places[removed[k]]
            image[y, x] = 0
        if gone:
            last = turn
        elif turn > last:  # converged
            break


@numba.njit(cache=True, nogil=True)
def _is_removable(image: Any, y: int, x: int, turn: int) -> bool:
    """Whether this subiteration removes a cell. Neighbours p2 ... p9, clockwise from above."""
    p2, p3, p4, p5 = image[y - 1, x], image[y - 1, x + 1], image[y, x + 1], image[y + 1, x + 1]
    p6, p7, p8, p9 = image[y + 1, x], image[y + 1, x - 1], image[y, x - 1], image[y - 1, x - 1]
    crossings = ((1 - p2) & (p3 | p4)) + ((1 - p4) & (p5 | p6)) + ((1 - p6) & (p7 | p8)) + ((1 - p8) & (p9 | p2))
    if crossings != 1:
        return False
    pairs = min(
        (p9 | p2) + (p3 | p4) + (p5 | p6) + (p7 | p8),
        (p2 | p3) + (p4 | p5) + (p6 | p7) + (p8 | p9),
    )
    if pairs < 2 or pairs > 3:
        return False
    if turn == 0:
        return bool(((p2 | p3 | (1 - p5)) & p4) == 0)
    return bool(((p6 | p7 | (1 - p9)) & p8) == 0)


TILE = 128  # raster cells to a side
RASTER_M = 1.0  # metres; smaller cells are joined, as positions are no better
NEAR = 2  # cells on each side of a line that count for it
EDGE = REACH + 1  # ridge cells around a tile that its lines depend on
# slices of a window (a tile and EDGE cells around), and of the tiles before, at and after it
_OF_WINDOW = {-1: slice(0, EDGE), 0: slice(EDGE, EDGE + TILE), 1: slice(EDGE + TILE, None)}
_OF_TILE = {-1: slice(TILE - EDGE, None), 0: slice(None), 1: slice(0, EDGE)}

Pages = Mapping[Block, TimedPages]
Tile = tuple[int, int]  # column and row


@dataclass(frozen=True)
class Skeleton:
    """Cells of lines, sorted.

    places: (n, 2) row and column in cells of raster_m. metres: (n, AXES) in the 5 x 5 cells around, in 1/4096 m.
    """

    places: Ints
    metres: Ints
    raster_m: float


@dataclass
class _Lines:
    places: Ints
    metres: Ints


class Skeletons:
    """Makes skeletons of one map; caches tiles by identity of their pages. Single-threaded. made: tiles computed."""

    def __init__(self, cell_m: float) -> None:
        self._join = max(1, int(RASTER_M / cell_m + 1e-9))
        self._raster_m = self._join * cell_m
        self._blur = Blur(self._raster_m)
        self._margin = self._blur.reach + self._blur.side
        self._pages: dict[Block, TimedPages] = {}
        self._ridges: dict[Tile, Bools] = {}  # only tiles with ridges
        self._lines: dict[Tile, _Lines] = {}
        self.made = 0

    def skeleton(self, pages: Pages) -> Skeleton:
        """Centre lines of a whole map."""
        known, self._pages = self._pages, dict(pages)
        changed = [block for block, own in pages.items() if known.get(block) is not own]
        axis_metres([pages[block] for block in changed])  # of all at once
        changed += [block for block in known if block not in pages]
        stale = self._near(changed)
        others = [tile for tile in stale if self._look(tile)]
        moved = {(x + dx, y + dy) for x, y in others for dx, dy in product((-1, 0, 1), repeat=2)}
        for tile in sorted(moved | (stale & self._lines.keys())):
            self._draw(tile, moved=tile in moved, stale=tile in stale)
        parts = self._lines.values()
        places = np.concatenate([np.zeros((0, 2), np.int64), *(part.places for part in parts)])
        metres = np.concatenate([np.zeros((0, AXES), np.int64), *(part.metres for part in parts)])
        order = np.argsort((places[:, 0] << 32) + places[:, 1])
        return Skeleton(places[order], metres[order], self._raster_m)

    def _near(self, blocks: Iterable[Block]) -> set[Tile]:
        corner = np.array(list(blocks), np.int64).reshape(-1, 2) * BLOCK_CELLS
        first = (corner // self._join - self._margin) // TILE
        last = ((corner + BLOCK_CELLS - 1) // self._join + self._margin) // TILE
        spans = np.unique(np.concatenate([first, last], axis=1), axis=0).tolist()
        return {
            tile
            for left, bottom, right, top in spans
            for tile in product(range(left, right + 1), range(bottom, top + 1))
        }

    def _look(self, tile: Tile) -> bool:
        """Returns whether the ridges of a tile changed."""
        self.made += 1
        now, known = ridges(self._axes(tile, self._margin), self._blur), self._ridges.get(tile)
        if not now.any():
            return self._ridges.pop(tile, None) is not None
        if known is not None and np.array_equal(known, now):
            return False
        self._ridges[tile] = now
        return True

    def _draw(self, tile: Tile, *, moved: bool, stale: bool) -> None:
        """moved: ridges here or next to it changed; stale: nearby evidence changed."""
        known = self._lines.get(tile)
        places = self._thinned(tile) if moved or known is None else known.places
        if not len(places):
            self._lines.pop(tile, None)
        elif stale or known is None or not np.array_equal(known.places, places):
            self._lines[tile] = _Lines(places, self._around(tile, places))

    def _thinned(self, tile: Tile) -> Ints:
        """Cells (n, 2) of a tile's lines."""
        if tile not in self._ridges:
            return np.zeros((0, 2), np.int64)
        mask = np.zeros((TILE + 2 * EDGE, TILE + 2 * EDGE), np.bool_)
        for dx, dy in product((-1, 0, 1), repeat=2):
            if (near := self._ridges.get((tile[0] + dx, tile[1] + dy))) is not None:
                mask[_OF_WINDOW[dy], _OF_WINDOW[dx]] = near[_OF_TILE[dy], _OF_TILE[dx]]
        lines = thinned(mask)[EDGE:-EDGE, EDGE:-EDGE]
        return np.asarray(np.argwhere(lines) + np.array(tile[::-1]) * TILE, np.int64)

    def _axes(self, tile: Tile, margin: int) -> Ints:
        """Metres (rows, columns, AXES) of a tile and its margin."""
        size = TILE + 2 * margin
        out = np.zeros((size, size, AXES), np.int64)
        _fill(*self._parts(tile, margin), out)
        return out

    def _around(self, tile: Tile, places: Ints) -> Ints:
        """Metres (n, AXES) of the 5 x 5 cells around cells (n, 2)."""
        numbers = np.full((TILE + 2 * NEAR, TILE + 2 * NEAR), -1, np.int64)
        own = places - np.array(tile[::-1]) * TILE + NEAR
        numbers[own[:, 0], own[:, 1]] = np.arange(len(own))
        out = np.zeros((len(places), AXES), np.int64)
        _add_around(*self._parts(tile, NEAR), numbers, out)
        return out

    def _parts(self, tile: Tile, margin: int) -> tuple[Ints, Ints, Ints, Ints, int, int, int]:
        """Arguments of `_fill`."""
        column, row = (TILE * index - margin for index in tile)
        size = TILE + 2 * margin
        spans = (
            range(at * self._join // BLOCK_CELLS, ((at + size) * self._join - 1) // BLOCK_CELLS + 1)
            for at in (column, row)
        )
        blocks = [block for block in product(*spans) if block in self._pages]
        parts = axis_metres([self._pages[block] for block in blocks])
        nothing = np.zeros(0, np.int64)
        codes, metres = (np.concatenate([nothing, *part]) for part in (zip(*parts, strict=True) if parts else ((), ())))
        ends = np.cumsum([len(part[0]) for part in parts], dtype=np.int64)
        return codes, metres, ends, np.array(blocks, np.int64).reshape(-1, 2) * BLOCK_CELLS, self._join, row, column


def axis_metres(pages: Sequence[TimedPages]) -> list[tuple[AnyArray, AnyArray]]:
    """Driven cells of blocks: cell * AXES + axis (n,), and metres (n,) in 1/4096 m."""
    lacking = [one for one in pages if axis_metres not in one.derived]
    for first in range(0, len(lacking), READ_BLOCKS):
        some = lacking[first : first + READ_BLOCKS]
        for one, sectors in zip(some, plane_counts(some, HEADING), strict=True):
            codes, metres = _driven(sectors)
            small = np.uint32 if metres.max(initial=0) < 2**32 else np.int64
            # few cells of a block are driven
            one.derived[axis_metres] = codes.astype(np.uint16), metres.astype(small)
    return [one.derived[axis_metres] for one in pages]


@numba.njit(cache=True, nogil=True)
def _driven(sectors: Any) -> tuple[Any, Any]:
    """counts: (sectors, cells)."""
    codes, metres, used = np.empty(CELLS * AXES, np.int64), np.empty(CELLS * AXES, np.int64), 0
    for cell in range(CELLS):
        for axis in range(AXES):
            count = sectors[axis, cell] + sectors[axis + AXES, cell]
            if count:
                codes[used], metres[used] = cell * AXES + axis, count
                used += 1
    return codes[:used].copy(), metres[:used].copy()


@numba.njit(cache=True, nogil=True)
def _fill(codes: Any, metres: Any, ends: Any, corners: Any, join: int, row: int, column: int, out: Any) -> None:
    """Rasterise blocks with first cells at corners (x, y); the raster begins at row, column."""
    rows, columns = out.shape[:2]
    first = 0
    for b in range(len(ends)):
        for i in range(first, ends[b]):
            cell, axis = codes[i] // AXES, codes[i] % AXES
            y = (corners[b, 1] + cell // BLOCK_CELLS) // join - row
            x = (corners[b, 0] + cell % BLOCK_CELLS) // join - column
            if 0 <= y < rows and 0 <= x < columns:
                out[y, x, axis] += metres[i]
        first = ends[b]


@numba.njit(cache=True, nogil=True)
def _add_around(
    codes: Any, metres: Any, ends: Any, corners: Any, join: int, row: int, column: int, numbers: Any, out: Any
) -> None:
    """Add metres, as in `_fill`, to out (n, AXES) of nearby cells; numbers: index into out, or -1."""
    rows, columns = numbers.shape
    first = 0
    for b in range(len(ends)):
        for i in range(first, ends[b]):
            cell, axis = codes[i] // AXES, codes[i] % AXES
            y = (corners[b, 1] + cell // BLOCK_CELLS) // join - row
            x = (corners[b, 0] + cell % BLOCK_CELLS) // join - column
            for near_y in range(max(y - NEAR, 0), min(y + NEAR + 1, rows)):
                for near_x in range(max(x - NEAR, 0), min(x + NEAR + 1, columns)):
                    number = numbers[near_y, near_x]
                    if number >= 0:
                        out[number, axis] += metres[i]
        first = ends[b]
