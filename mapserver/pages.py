"""Pages: the evidence of one block over a span of time, packed and never changed.

Of the 106 counts of a cell about ten are not zero. A page keeps those alone, 4 bytes each, and 25 bytes per cell for
bitmaps and newest stamp. As nothing changes a page, readers and snapshots take it without a copy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver import evidence as ev
from protocol.arrays import AnyArray, Bools, Ints, Table

# place: bin * 256 + cell. Counts of a few passes fit into 16 bits; a page with one that does not is a wide one.
NARROW = np.dtype([("place", "<u2"), ("count", "<u2")])
WIDE = np.dtype([("place", "<u2"), ("count", "<u4")])
CELL = np.dtype([("cell", "u1"), ("bits", "<u8", (2,)), ("newest_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class Page:
    """Votes (m,) NARROW or WIDE in the order of their places, and cells (k,) CELL in the order of their numbers."""

    votes: Table
    cells: Table

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return self.votes.nbytes + self.cells.nbytes

    def of_cells(self, wanted: Bools) -> Page:
        """Only what it has of some cells (256,)."""
        return Page(self.votes[wanted[self.votes["place"] % ev.CELLS]], self.cells[wanted[self.cells["cell"]]])

    def add_to(self, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> None:
        """Add to counts (COUNTS * 256,), bitmaps (256, 2), newest_ns (256,)."""
        counts[self.votes["place"]] += self.votes["count"]
        cells = self.cells["cell"]
        bitmaps[cells] |= self.cells["bits"]
        newest_ns[cells] = np.maximum(newest_ns[cells], self.cells["newest_ns"])


def pack(counts: NDArray[np.uint32], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> Page:
    """Move counts (COUNTS, 256), bitmaps (2, 256), newest_ns (256,) into a page: they are zero afterwards.

    Cells that were never touched have no stamp.
    """
    votes = _take(counts.reshape(-1))
    cell = np.flatnonzero(newest_ns)
    cells = np.empty(len(cell), CELL)
    cells["cell"], cells["bits"], cells["newest_ns"] = cell, bitmaps[:, cell].T, newest_ns[cell]
    bitmaps[:] = 0
    newest_ns[:] = 0
    return Page(votes, cells)


def merge(one: Page, other: Page) -> Page:
    """Sum of two pages of the same block: counts saturate, so that any order of merging gives the same page."""
    cell = np.union1d(one.cells["cell"], other.cells["cell"])
    cells = np.zeros(len(cell), CELL)
    cells["cell"] = cell
    for page in (one, other):
        at = np.searchsorted(cell, page.cells["cell"])
        cells["bits"][at] |= page.cells["bits"]
        cells["newest_ns"][at] = np.maximum(cells["newest_ns"][at], page.cells["newest_ns"])
    return Page(_add(one.votes, other.votes), cells)


def take_numpy(counts: NDArray[np.uint32]) -> Table:
    """Move what is not zero in counts (COUNTS * 256,) to votes."""
    place = np.flatnonzero(counts)
    votes = _votes(place, counts[place])
    counts[place] = 0
    return votes


def add_numpy(one: Table, other: Table) -> Table:
    """Sum of votes, saturated."""
    place = np.union1d(one["place"], other["place"])
    count = np.zeros(len(place), np.uint64)
    for votes in (one, other):
        count[np.searchsorted(place, votes["place"])] += votes["count"]
    return _votes(place, np.minimum(count, np.uint64(ev.COUNT_MAX)))


def _votes(place: AnyArray, count: AnyArray) -> Table:
    fits = not len(count) or int(count.max()) <= np.iinfo(np.uint16).max
    votes = np.empty(len(place), NARROW if fits else WIDE)
    votes["place"], votes["count"] = place, count
    return votes


def _with_numba() -> tuple[Callable[[NDArray[np.uint32]], Table], Callable[[Table, Table], Table]]:
    """The same two in numba, many times faster."""
    from mapserver import pages_numba

    def take(counts: NDArray[np.uint32]) -> Table:
        place, count = np.empty(len(counts), np.uint16), np.empty(len(counts), np.uint32)
        found = pages_numba.take(counts, place, count)
        return _votes(place[:found], count[:found])

    def add(one: Table, other: Table) -> Table:
        most = len(one) + len(other)
        place, count = np.empty(most, np.uint16), np.empty(most, np.uint32)
        found = pages_numba.add(one, other, place, count)
        return _votes(place[:found], count[:found])

    return take, add


try:
    _take, _add = _with_numba()
except ImportError:
    _take, _add = take_numpy, add_numpy
