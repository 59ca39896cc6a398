"""Pages: the evidence of one block over a span of time, packed and never changed.

Of the 107 counts of a cell about ten are not zero. A page keeps those alone, with bitmaps and newest stamp of its
cells. What stays in memory is more compact still: about 45 bytes per cell and page. As nothing changes pages, readers
and snapshots take them without a copy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence import page_kernels
from mapserver.evidence.buffers import Buffers
from protocol.arrays import AnyArray, Bools, Ints, Table

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


class PackedPages(NamedTuple):
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
        """Pages in the order of their rows in the table, whose first end where the next begin."""
        return compact(np.array([len(table)]), table, votes, cells, Buffers())[0]

    @classmethod
    def joined(cls, parts: Sequence[CompactPages]) -> CompactPages:
        """Pages of several blocks end to end."""
        table = np.concatenate([part.table for part in parts])
        table[:, 2:] += _repeated(
            [(len(part.runs), len(part.cells), len(part.marks), len(part.marks)) for part in parts],
            [len(part.table) for part in parts],
        )
        runs, cells, counts, marks, words = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("runs", "cells", "counts", "marks", "words")
        )
        high = np.empty(0, np.uint16)
        if any(len(part.high) for part in parts):
            high = np.concatenate([part.high if len(part.high) else np.zeros_like(part.counts) for part in parts])
        return cls(table, runs, cells, counts, high, marks, words)

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

    def expanded_votes(self) -> tuple[Ints, NDArray[np.uint64]]:
        """The table and the votes alone, as in PackedPages."""
        table, votes = self.table.astype(np.int64), np.empty(len(self.cells), np.uint64)
        page_kernels.expand_votes(table, self.runs, self.cells, self.counts, self.high, votes)
        return table, votes

    def expand_into(self, pages: PackedPages) -> None:
        """Write into arrays of the right lengths; their table is a copy of this one."""
        page_kernels.expand_votes(pages.table, self.runs, self.cells, self.counts, self.high, pages.votes)
        page_kernels.expand_cells(pages.table, self.marks, self.words, pages.cells)


def copied(part: AnyArray) -> AnyArray:
    """A copy that keeps nothing else alive. Not numpy's: that lets go of Python's lock where it is long.

    Two threads that fold would wait for each other longer than a copy takes.
    """
    return np.frombuffer(part.tobytes(), part.dtype).reshape(part.shape)


NO_HIGH = copied(np.empty(0, np.uint16))  # not to be written either: kernels are compiled for either kind of array


def compact(ends: Ints, table: Ints, votes: NDArray[np.uint64], cells: Table, buffers: Buffers) -> list[CompactPages]:
    """Pages of several blocks, each whole and by itself.

    ends (b,): of the pages of each block. table (n, 6), votes, cells: as of PackedPages, pages end to end.
    """
    n, array = len(votes), buffers.array
    runs, of_cells, counts = array("runs", n, np.uint8, 2), array("places", n, np.uint8), array("counts", n, np.uint16)
    high = np.empty(n if int(votes.max(initial=0)) >= 2**32 else 0, np.uint16)
    marks, words = array("marks", len(cells), np.uint8, 4), array("words", len(table) + 3 * len(cells), np.uint64)
    word_ends = np.empty(len(table), np.int64)
    table = table.copy()
    page_kernels.compact_cells(table, cells, marks, words, word_ends)
    page_kernels.compact_votes(table, votes, runs, of_cells, counts, high)
    # where the parts of each block end: pages, runs, votes, marks, words
    until = np.zeros((len(ends) + 1, 5), np.int64)
    has_pages = ends > 0
    until[1:, 0] = ends
    until[1:, 1:4][has_pages] = table[ends[has_pages] - 1][:, [2, 3, 5]]
    until[1:, 4][has_pages] = word_ends[ends[has_pages] - 1]
    table[:, 2:] -= np.repeat(until[:-1, [1, 2, 3, 3]], np.diff(until[:, 0]), axis=0)
    small = table.astype(np.int32)
    blocks = []
    for (page, run, vote, mark, word), (page_, run_, vote_, mark_, word_) in pairwise(until.tolist()):
        blocks.append(
            CompactPages(
                copied(small[page:page_]),
                copied(runs[run:run_]),
                copied(of_cells[vote:vote_]),
                copied(counts[vote:vote_]),
                copied(high[vote:vote_]) if len(high) and high[vote:vote_].any() else NO_HIGH,
                copied(marks[mark:mark_]),
                copied(words[word:word_]),
            )
        )
    return blocks


def _repeated(lengths: Sequence[tuple[int, ...]], times: Sequence[int]) -> Ints:
    """Where the parts of each block begin, once for each of its pages."""
    begins = np.cumsum([(0,) * len(lengths[0]), *lengths[:-1]], axis=0)
    return np.repeat(begins, times, axis=0)


def pick(page: Page, wanted: Bools) -> Page:
    """Only what a page has of some cells (256,)."""
    votes = page.votes[wanted[page.votes["place"] % ev.CELLS]]
    return Page(votes, page.cells[wanted[page.cells["cell"]]])


EMPTY = CompactPages.from_packed(np.empty((0, 6), np.int64), np.empty(0, np.uint64), np.empty(0, CELL))
