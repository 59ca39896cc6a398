"""Pages: the evidence of one block over a span of time, packed and never changed.

Of the 106 counts of a cell about ten are not zero. A page keeps those alone, 4 bytes each, and 25 bytes per cell for
bitmaps and newest stamp. As nothing changes a page, readers and snapshots take it without a copy. The loops are
compiled by numba (page_kernels.py); tests/reference/pages.py computes the same bits in numpy.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence import page_kernels as kernels
from protocol.arrays import Bools, Floats, Ints, Table

# place: bin * 256 + cell. Counts of a few passes fit into 16 bits; a page with one that does not is a wide one.
NARROW = np.dtype([("place", "<u2"), ("count", "<u2")])
WIDE = np.dtype([("place", "<u2"), ("count", "<u4")])
CELL = np.dtype([("cell", "u1"), ("visits", "<u8"), ("machines", "<u8"), ("newest_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class Page:
    """Votes (m,) NARROW or WIDE in the order of their places, and cells (k,) CELL in the order of their numbers."""

    votes: Table
    cells: Table

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return self.votes.nbytes + self.cells.nbytes

    def add_to(self, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> None:
        """Add to counts (COUNTS * 256,), bitmaps (256, 2), newest_ns (256,)."""
        counts[self.votes["place"]] += self.votes["count"]
        cells = self.cells["cell"]
        bitmaps[cells, ev.VISITS] |= self.cells["visits"]
        bitmaps[cells, ev.MACHINES] |= self.cells["machines"]
        newest_ns[cells] = np.maximum(newest_ns[cells], self.cells["newest_ns"])


def frozen(records: Table) -> Table:
    """A copy that cannot be written to; much quicker than `copy`, which goes through records field by field."""
    return np.frombuffer(records.tobytes(), records.dtype)


_scratch = threading.local()  # for `pack`; grids are folded by several threads


def pack(counts: NDArray[np.uint32], planes: Bools, bitmaps: NDArray[np.uint64], newest_ns: Ints) -> Page:
    """Move counts (COUNTS, 256), bitmaps (2, 256), newest_ns (256,) into a page: they are zero afterwards.

    planes: (COUNTS,) which of the counts have been written to. Cells that were never touched have no stamp.
    """
    if not hasattr(_scratch, "space"):
        _scratch.space = _space(ev.COUNTS * ev.CELLS, ev.CELLS)
    narrow, wide, cells = _scratch.space
    packed = kernels.take_votes(counts, planes, newest_ns, narrow, wide)
    return _page(narrow, wide, packed, cells[: kernels.take_cells(bitmaps, newest_ns, cells)])


def merge(one: Page, other: Page) -> Page:
    """Sum of two pages of the same block: counts saturate, so that any order of merging gives the same page."""
    narrow, wide, cells = _space(len(one.votes) + len(other.votes), len(one.cells) + len(other.cells))
    merged = kernels.add_votes(one.votes, other.votes, narrow, wide)
    return _page(narrow, wide, merged, cells[: kernels.add_cells(one.cells, other.cells, cells)])


def pick(page: Page, chosen: Bools) -> Page:
    """Only what a page has of the chosen cells (256,)."""
    narrow, wide, cells = _space(len(page.votes), len(page.cells))
    picked = kernels.pick_votes(page.votes, chosen, narrow, wide)
    return _page(narrow, wide, picked, cells[: kernels.pick_cells(page.cells, chosen, cells)])


def moments(page: Page, part: slice) -> Floats:
    """Sums (3, 256) of counts, counts times bin and counts times bin squared, of one part of the counts."""
    out = np.zeros((3, ev.CELLS))
    kernels.moments(page.votes, part.start, part.stop, out)
    return out


def dtype_for(largest: int) -> np.dtype[np.void]:
    """The smallest kind of votes that holds this count."""
    return NARROW if largest <= np.iinfo(np.uint16).max else WIDE


def _space(votes: int, cells: int) -> tuple[Table, Table, Table]:
    return np.empty(votes, NARROW), np.empty(votes, WIDE), np.empty(cells, CELL)


def _page(narrow: Table, wide: Table, written: tuple[int, int], cells: Table) -> Page:
    """Make a page of what a kernel has written; written: how many votes, and the largest count."""
    votes, largest = written
    fitting = narrow if dtype_for(largest) == NARROW else wide
    return Page(frozen(fitting[:votes]), frozen(cells))
