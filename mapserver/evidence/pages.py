"""Pages: the evidence of one block over a span of time, packed and never changed.

Of the 106 counts of a cell about ten are not zero. A page keeps those alone, 4 bytes each, and 25 bytes per cell for
bitmaps and newest stamp. As nothing changes a page, readers and snapshots take it without a copy.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from protocol.arrays import AnyArray, Bools, Floats, Ints, Table

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


Pack = Callable[[NDArray[np.uint32], Bools, NDArray[np.uint64], Ints], Page]
Merge = Callable[[Page, Page], Page]
Pick = Callable[[Page, Bools], Page]
Moments = Callable[[Page, slice], Floats]


def pack_numpy(counts: NDArray[np.uint32], planes: Bools, bitmaps: NDArray[np.uint64], newest_ns: Ints) -> Page:
    """Move counts (COUNTS, 256), bitmaps (2, 256), newest_ns (256,) into a page: they are zero afterwards.

    planes: (COUNTS,) which of the counts have been written to. Cells that were never touched have no stamp.
    """
    flat, cell = counts.reshape(-1), np.flatnonzero(newest_ns)
    place = np.flatnonzero(flat)
    votes = _votes(place, flat[place])
    cells = np.empty(len(cell), CELL)
    cells["cell"], cells["newest_ns"] = cell, newest_ns[cell]
    cells["visits"], cells["machines"] = bitmaps[:, cell]
    flat[place] = 0
    planes[:] = False
    bitmaps[:] = 0
    newest_ns[:] = 0
    return Page(votes, frozen(cells))


def merge_numpy(one: Page, other: Page) -> Page:
    """Sum of two pages of the same block: counts saturate, so that any order of merging gives the same page."""
    place = np.union1d(one.votes["place"], other.votes["place"])
    cell = np.union1d(one.cells["cell"], other.cells["cell"])
    count, cells = np.zeros(len(place), np.uint64), np.zeros(len(cell), CELL)
    cells["cell"] = cell
    for page in (one, other):
        count[np.searchsorted(place, page.votes["place"])] += page.votes["count"]
        at = np.searchsorted(cell, page.cells["cell"])
        cells["visits"][at] |= page.cells["visits"]
        cells["machines"][at] |= page.cells["machines"]
        cells["newest_ns"][at] = np.maximum(cells["newest_ns"][at], page.cells["newest_ns"])
    return Page(_votes(place, np.minimum(count, np.uint64(ev.COUNT_MAX))), frozen(cells))


def pick_numpy(page: Page, wanted: Bools) -> Page:
    """Only what a page has of some cells (256,)."""
    votes = page.votes[wanted[page.votes["place"] % ev.CELLS]]
    return Page(_votes(votes["place"], votes["count"]), frozen(page.cells[wanted[page.cells["cell"]]]))


def moments_numpy(page: Page, part: slice) -> Floats:
    """Sums (3, 256) of counts, counts times bin and counts times bin squared, of one part of the counts."""
    plane, cell = np.divmod(page.votes["place"].astype(np.int64), ev.CELLS)
    wanted = (plane >= part.start) & (plane < part.stop)
    bins, count = plane[wanted] - part.start, page.votes["count"][wanted].astype(np.float64)
    return np.stack([np.bincount(cell[wanted], count * bins**power, ev.CELLS) for power in range(3)])


def _votes(place: AnyArray, count: AnyArray) -> Table:
    votes = np.empty(len(place), _kind(int(count.max(initial=0))))
    votes["place"], votes["count"] = place, count
    return frozen(votes)


def _kind(largest: int) -> np.dtype[np.void]:
    return NARROW if largest <= np.iinfo(np.uint16).max else WIDE


def _with_numba() -> tuple[Pack, Merge, Pick, Moments]:
    """The same in numba, several times faster."""
    from mapserver.evidence import page_kernels as kernels

    def space(votes: int, cells: int) -> tuple[Table, Table, Table]:
        return np.empty(votes, NARROW), np.empty(votes, WIDE), np.empty(cells, CELL)

    def page(votes: tuple[Table, Table], cells: Table, found: tuple[int, int], touched: int) -> Page:
        narrow, wide = votes
        fitting = narrow if _kind(found[1]) == NARROW else wide
        return Page(frozen(fitting[: found[0]]), frozen(cells[:touched]))

    scratch = threading.local()  # grids are folded by several threads

    def pack(counts: NDArray[np.uint32], planes: Bools, bitmaps: NDArray[np.uint64], newest_ns: Ints) -> Page:
        if not hasattr(scratch, "space"):
            scratch.space = space(ev.COUNTS * ev.CELLS, ev.CELLS)
        narrow, wide, cells = scratch.space
        found = kernels.take_votes(counts, planes, newest_ns, narrow, wide)
        return page((narrow, wide), cells, found, kernels.take_cells(bitmaps, newest_ns, cells))

    def merge(one: Page, other: Page) -> Page:
        narrow, wide, cells = space(len(one.votes) + len(other.votes), len(one.cells) + len(other.cells))
        found = kernels.add_votes(one.votes, other.votes, narrow, wide)
        return page((narrow, wide), cells, found, kernels.add_cells(one.cells, other.cells, cells))

    def pick(of: Page, wanted: Bools) -> Page:
        narrow, wide, cells = space(len(of.votes), len(of.cells))
        found = kernels.pick_votes(of.votes, wanted, narrow, wide)
        return page((narrow, wide), cells, found, kernels.pick_cells(of.cells, wanted, cells))

    def moments(of: Page, part: slice) -> Floats:
        out = np.zeros((3, ev.CELLS))
        kernels.moments(of.votes, part.start, part.stop, out)
        return out

    return pack, merge, pick, moments


try:
    pack, merge, pick, moments = _with_numba()
except ImportError:
    pack, merge, pick, moments = pack_numpy, merge_numpy, pick_numpy, moments_numpy
