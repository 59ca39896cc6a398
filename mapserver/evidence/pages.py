"""Pages: the evidence of one block over a span of time, packed and never changed.

Of the 106 counts of a cell about ten are not zero. A page keeps those alone, with bitmaps and newest stamp of its
cells. What stays in memory is more compact still: about 45 bytes per cell and page. As nothing changes pages, readers
and snapshots take them without a copy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence import page_kernels
from protocol.arrays import Bools, Ints, Table

# place: bin * 256 + cell. Counts of a few passes fit into 16 bits; where one does not, all of a block are wide.
TIERS = 4  # of a timeline: buckets, hours, days, all before
NARROW = np.dtype([("place", "<u2"), ("count", "<u2")])
WIDE = np.dtype([("place", "<u2"), ("count", "<u4")])
CELL = np.dtype([("cell", "u1"), ("visits", "<u8"), ("machines", "<u8"), ("newest_ns", "<i8")])
RAW_CELL = np.dtype((np.void, CELL.itemsize))  # numpy copies records field by field, and these at once


@dataclass(frozen=True, slots=True)
class Page:
    """Votes (m,) NARROW or WIDE in the order of their places, and cells (k,) CELL in the order of their numbers."""

    votes: Table
    cells: Table

    def add_to(self, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> None:
        """Add to counts (COUNTS * 256,), bitmaps (256, 2), newest_ns (256,)."""
        counts[self.votes["place"]] += self.votes["count"]
        cells = self.cells["cell"]
        bitmaps[cells, ev.VISITS] |= self.cells["visits"]
        bitmaps[cells, ev.MACHINES] |= self.cells["machines"]
        newest_ns[cells] = np.maximum(newest_ns[cells], self.cells["newest_ns"])


@dataclass(frozen=True, slots=True)
class PackedPages:
    """Pages of one block end to end: few long arrays instead of many short ones.

    table (n, 6): tier, index, first and end of the votes and of the cells of each page. votes (m,), uint32 or,
    where one does not fit, uint64: place in the lower 16 bits, count above; cells (k,) CELL.
    """

    table: Ints
    votes: NDArray[np.unsignedinteger[Any]]
    cells: Table

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Tier, index on it, and page."""
        votes: Table = np.empty(len(self.votes), NARROW if int(self.votes.max(initial=0)) < 2**32 else WIDE)
        votes["place"], votes["count"] = self.votes & np.uint64(0xFFFF), self.votes >> np.uint64(16)
        for tier, index, first, end, first_cell, end_cell in self.table.tolist():
            yield tier, index, Page(votes[first:end], self.cells[first_cell:end_cell])


@dataclass(frozen=True, slots=True)
class CompactPages:
    """As PackedPages, in less space (see page_kernels.py).

    table (n, 6) int32: tier, index, ends of runs and votes, first and end of cells; runs (r, 2): plane, and number of
    its votes less one; cells (m,), counts (m,) and high (m,), or none: of the votes; marks (k, 4): of the cells, the
    number, and where its visits, machines and stamp stand among the words of its page; words: of all pages.
    """

    table: NDArray[np.int32]
    runs: NDArray[np.uint8]
    cells: NDArray[np.uint8]
    counts: NDArray[np.uint16]
    high: NDArray[np.uint16]
    marks: NDArray[np.uint8]
    words: NDArray[np.uint64]

    @classmethod
    def from_packed(cls, table: Ints, votes: NDArray[np.uint64], cells: Table) -> CompactPages:
        """Pages in the order of their rows in the table, whose first end where the next begin. The table is changed."""
        n = len(votes)
        runs, of_cells, counts = np.empty((n, 2), np.uint8), np.empty(n, np.uint8), np.empty(n, np.uint16)
        high = np.empty(0 if int(votes.max(initial=0)) < 2**32 else n, np.uint16)
        marks, words = np.empty((len(cells), 4), np.uint8), np.empty(len(table) + 3 * len(cells), np.uint64)
        used = page_kernels.compact_cells(table, cells, marks, words)
        used_runs = page_kernels.compact_votes(table, votes, runs, of_cells, counts, high)
        return cls(table.astype(np.int32), runs[:used_runs].copy(), of_cells, counts, high, marks, words[:used].copy())

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return sum(getattr(self, name).nbytes for name in self.__slots__)

    @property
    def is_sound(self) -> bool:
        """Whether these can be pages; nothing else is looked at before they are expanded."""
        tier, index = self.table[:, 0], self.table[:, 1]
        in_place = bool((tier >= 0).all() and (tier < TIERS).all() and (index >= 0).all())
        votes = in_place and page_kernels.are_votes(self.table, self.runs, self.cells, self.counts, self.high)
        return bool(votes and page_kernels.are_cells(self.table, self.marks, self.words))

    def expanded(self) -> PackedPages:
        """Undo `from_packed`."""
        pages = PackedPages(
            self.table.astype(np.int64), np.empty(len(self.cells), np.uint64), np.empty(len(self.marks), CELL)
        )
        self.expand_into(pages)
        return pages

    def expand_into(self, pages: PackedPages) -> None:
        """Write into arrays of the right lengths; their table is a copy of this one."""
        page_kernels.expand_votes(pages.table, self.runs, self.cells, self.counts, self.high, pages.votes)
        page_kernels.expand_cells(pages.table, self.marks, self.words, pages.cells)


def frozen(records: Table) -> Table:
    """A copy that cannot be written to; much quicker than `copy`, which goes through records field by field."""
    return np.frombuffer(records.tobytes(), records.dtype)


def pick(page: Page, wanted: Bools) -> Page:
    """Only what a page has of some cells (256,)."""
    votes = page.votes[wanted[page.votes["place"] % ev.CELLS]]
    return Page(votes, page.cells[wanted[page.cells["cell"]]])


EMPTY = CompactPages.from_packed(np.empty((0, 6), np.int64), np.empty(0, np.uint64), np.empty(0, CELL))
