"""The grid in memory: 16 x 16 cell blocks per time bucket, allocated where somebody drove. One thread owns it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver import evidence as ev
from mapserver.fold import kernel
from mapserver.votes import FoldConfig, Votes, is_foldable, prepare
from protocol.arrays import Ints, Table
from protocol.geometry import BLOCK_CELLS, CellWindow

CELLS = BLOCK_CELLS * BLOCK_CELLS
# Block columns and rows are packed as 18 bits each below the bucket, which has 27: enough for 5 cm cells 100 km away,
# and for minutes until the year 2100.
_BITS = 18
_HALF = 1 << (_BITS - 1)
READ_BLOCKS = 256  # summed at once: 60 MB


@dataclass(frozen=True)
class GridState:
    """Everything that a snapshot keeps.

    codes: (slots,) packed bucket, block column and block row; the arrays as in Evidence, per slot.
    """

    codes: Ints
    counts: NDArray[np.uint32]
    bitmaps: NDArray[np.uint64]
    newest: Ints
    folded: int
    skipped: int


class Grid:
    """Evidence of one site.

    folded, skipped: how many samples voted, and how many were too unsure of their place to vote.
    """

    def __init__(self, cell_m: float, config: FoldConfig) -> None:
        self.cell_m = cell_m
        self.config = config
        self.folded = 0
        self.skipped = 0
        self._kernel = kernel(config.kernel)
        self._slots: dict[int, int] = {}
        self._counts = np.zeros((0, CELLS, ev.COUNTS), np.uint32)
        self._bitmaps = np.zeros((0, CELLS, 2), np.uint64)
        self._newest = np.zeros((0, CELLS), np.int64)

    def fold(self, rows: Table, machine: str) -> None:
        """Fold samples of one machine; commutative, not idempotent: exactly-once is decided at the journal."""
        foldable = is_foldable(rows, self.config)
        self.skipped += int((~foldable).sum())
        rows = rows[foldable]
        if not len(rows):
            return
        votes = prepare(rows, machine, self.cell_m, self.config)
        corner = votes.origin // BLOCK_CELLS
        slots = self._slots_of(votes, corner)
        self._kernel(votes, slots, corner, self._counts, self._bitmaps, self._newest)
        self.folded += len(rows)

    def blocks_in(self, window: CellWindow) -> list[tuple[int, int]]:
        """Block columns and rows with evidence that the window touches."""
        first_x, last_x = window.column // BLOCK_CELLS, (window.column + window.columns - 1) // BLOCK_CELLS
        first_y, last_y = window.row // BLOCK_CELLS, (window.row + window.rows - 1) // BLOCK_CELLS
        found = {(x, y) for _, x, y in map(_unpack, self._slots)}
        return sorted((x, y) for x, y in found if first_x <= x <= last_x and first_y <= y <= last_y)

    def evidence(self, blocks: Iterable[tuple[int, int]]) -> ev.Evidence:
        """Copy the evidence of these blocks, summed over time buckets."""
        order = {block: i for i, block in enumerate(blocks)}
        counts = np.zeros((len(order), CELLS, ev.COUNTS), np.uint64)
        bitmaps = np.zeros((len(order), CELLS, 2), np.uint64)
        newest = np.zeros((len(order), CELLS), np.int64)
        for code, slot in self._slots.items():
            _, x, y = _unpack(code)
            if (i := order.get((x, y))) is not None:
                counts[i] += self._counts[slot]
                bitmaps[i] |= self._bitmaps[slot]
                np.maximum(newest[i], self._newest[slot], out=newest[i])
        return ev.Evidence(counts, bitmaps, newest)

    def bounds(self) -> tuple[int, int, int, int] | None:
        """First column, first row, end column, end row of all blocks with evidence."""
        places = [_unpack(code)[1:] for code in self._slots]
        if not places:
            return None
        xs, ys = [x for x, _ in places], [y for _, y in places]
        n = BLOCK_CELLS
        return min(xs) * n, min(ys) * n, (max(xs) + 1) * n, (max(ys) + 1) * n

    def known_cells(self) -> int:
        """How many cells have any evidence."""
        known: dict[tuple[int, int], NDArray[np.bool_]] = {}
        for code, slot in self._slots.items():
            place = _unpack(code)[1:]
            seen = self._counts[slot, :, ev.WEIGHT] > 0
            known[place] = known[place] | seen if place in known else seen
        return int(sum(cells.sum() for cells in known.values()))

    def state(self) -> GridState:
        """Copy everything, in the order of the codes, so that equal grids have equal states."""
        codes = np.array(sorted(self._slots), np.int64)
        slots = np.array([self._slots[int(code)] for code in codes], np.int64)
        arrays = (self._counts[slots], self._bitmaps[slots], self._newest[slots])
        return GridState(codes, *arrays, self.folded, self.skipped)

    @classmethod
    def from_state(cls, cell_m: float, config: FoldConfig, state: GridState) -> Grid:
        """Undo `state`."""
        grid = cls(cell_m, config)
        grid._counts, grid._bitmaps, grid._newest = state.counts, state.bitmaps, state.newest
        grid._slots = {int(code): i for i, code in enumerate(state.codes)}
        grid.folded, grid.skipped = state.folded, state.skipped
        return grid

    def _slots_of(self, votes: Votes, corner: Ints) -> Ints:
        """Slots (n, k, k) of all blocks that the stencils touch, allocated where they are new."""
        last = (votes.origin + votes.size[:, None] - 1) // BLOCK_CELLS
        k = int((last - corner).max()) + 1
        steps = np.arange(k)
        x = np.minimum(corner[:, 0, None, None] + steps[None, None, :], last[:, 0, None, None])
        y = np.minimum(corner[:, 1, None, None] + steps[None, :, None], last[:, 1, None, None])
        codes = (votes.bucket[:, None, None] << 2 * _BITS) | ((x + _HALF) << _BITS) | (y + _HALF)
        unique, inverse = np.unique(codes, return_inverse=True)
        slots = np.fromiter((self._slot(code) for code in unique.tolist()), np.int64, len(unique))
        return slots[inverse].reshape(codes.shape)

    def _slot(self, code: int) -> int:
        slot = self._slots.get(code)
        if slot is None:
            slot = self._slots[code] = len(self._slots)
            if slot >= len(self._counts):
                self._allocate(max(8, 2 * slot))
        return slot

    def _allocate(self, slots: int) -> None:
        """Make room; what is there is kept."""
        more = [(0, slots - len(self._counts)), (0, 0)]
        self._counts = np.pad(self._counts, [*more, (0, 0)])
        self._bitmaps = np.pad(self._bitmaps, [*more, (0, 0)])
        self._newest = np.pad(self._newest, more)


def chunks(blocks: list[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    """Cut a list of blocks into pieces that are read at once."""
    for first in range(0, len(blocks), READ_BLOCKS):
        yield blocks[first : first + READ_BLOCKS]


def _unpack(code: int) -> tuple[int, int, int]:
    """Bucket, block column, block row."""
    mask = (1 << _BITS) - 1
    return code >> 2 * _BITS, (code >> _BITS & mask) - _HALF, (code & mask) - _HALF
