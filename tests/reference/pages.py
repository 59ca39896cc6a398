"""Pages in numpy: what the kernels behind mapserver/evidence/pages.py must give, bit for bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import CELL, Page, dtype_for, frozen
from protocol.arrays import AnyArray, Bools, Floats, Ints, Table


def pack(counts: NDArray[np.uint32], planes: Bools, bitmaps: NDArray[np.uint64], newest_ns: Ints) -> Page:
    """As `pages.pack`."""
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


def merge(one: Page, other: Page) -> Page:
    """As `pages.merge`."""
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


def pick(page: Page, chosen: Bools) -> Page:
    """As `pages.pick`."""
    votes = page.votes[chosen[page.votes["place"] % ev.CELLS]]
    return Page(_votes(votes["place"], votes["count"]), frozen(page.cells[chosen[page.cells["cell"]]]))


def moments(page: Page, part: slice) -> Floats:
    """As `pages.moments`."""
    plane, cell = np.divmod(page.votes["place"].astype(np.int64), ev.CELLS)
    inside = (plane >= part.start) & (plane < part.stop)
    bins, count = plane[inside] - part.start, page.votes["count"][inside].astype(np.float64)
    return np.stack([np.bincount(cell[inside], count * bins**power, ev.CELLS) for power in range(3)])


def _votes(place: AnyArray, count: AnyArray) -> Table:
    votes = np.empty(len(place), dtype_for(int(count.max(initial=0))))
    votes["place"], votes["count"] = place, count
    return frozen(votes)
