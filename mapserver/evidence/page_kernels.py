"""Packing and merging of pages in numba. Imported only where numba is installed; pages.py has the same in numpy.

Both write votes twice, as NARROW and as WIDE records: which of them fits is known when all are written.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNT_MAX


@numba.njit(cache=True, nogil=True)
def take_votes(counts: Any, planes: Any, newest_ns: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Move what is not zero in counts (COUNTS, 256) to votes; returns how many there are, and the largest count.

    planes (COUNTS,): which of them have been written to; most have not, and are left in peace.
    """
    found, largest = 0, np.uint32(0)
    touched = np.flatnonzero(newest_ns)
    for plane in np.flatnonzero(planes):
        cells = counts[plane]
        planes[plane] = False
        for i in touched:
            if cells[i]:
                narrow[found].place, narrow[found].count = plane * CELLS + i, cells[i]
                wide[found].place, wide[found].count = plane * CELLS + i, cells[i]
                largest = max(largest, cells[i])
                cells[i] = 0
                found += 1
    return found, int(largest)


@numba.njit(cache=True, nogil=True)
def take_cells(bitmaps: Any, newest_ns: Any, out: Any) -> int:
    """Move bitmaps (2, 256) and stamps (256,) of touched cells to cells; returns how many there are."""
    found = 0
    for i in range(CELLS):
        if newest_ns[i]:
            out[found].cell, out[found].newest_ns = i, newest_ns[i]
            out[found].visits, out[found].machines = bitmaps[0, i], bitmaps[1, i]
            bitmaps[0, i] = bitmaps[1, i] = newest_ns[i] = 0
            found += 1
    return found


@numba.njit(cache=True, nogil=True)
def pick_votes(votes: Any, wanted: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Votes of the cells (256,) that are wanted; returns how many there are, and the largest count."""
    found, largest = 0, np.uint32(0)
    for i in range(len(votes)):
        if wanted[votes[i].place % CELLS]:
            narrow[found].place, narrow[found].count = votes[i].place, votes[i].count
            wide[found].place, wide[found].count = votes[i].place, votes[i].count
            largest = max(largest, np.uint32(votes[i].count))
            found += 1
    return found, int(largest)


@numba.njit(cache=True, nogil=True)
def pick_cells(cells: Any, wanted: Any, out: Any) -> int:
    """Cells that are wanted; returns how many there are."""
    found = 0
    for i in range(len(cells)):
        if wanted[cells[i].cell]:
            out[found] = cells[i]
            found += 1
    return found


@numba.njit(cache=True, nogil=True)
def add_votes(one: Any, other: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Merge votes in the order of places, saturated; returns how many there are, and the largest count."""
    i, j, found, largest = 0, 0, 0, np.uint64(0)
    while i < len(one) or j < len(other):
        of_one = j == len(other) or (i < len(one) and one[i].place <= other[j].place)
        of_other = i == len(one) or (j < len(other) and other[j].place <= one[i].place)
        place = one[i].place if of_one else other[j].place
        count = np.uint64(0)
        if of_one:
            count += np.uint64(one[i].count)
            i += 1
        if of_other:
            count += np.uint64(other[j].count)
            j += 1
        count = min(count, np.uint64(COUNT_MAX))
        narrow[found].place, narrow[found].count = place, count
        wide[found].place, wide[found].count = place, count
        largest = max(largest, count)
        found += 1
    return found, int(largest)


@numba.njit(cache=True, nogil=True)
def add_cells(one: Any, other: Any, out: Any) -> int:
    """Merge cells in the order of their numbers; returns how many there are."""
    i, j, found = 0, 0, 0
    while i < len(one) or j < len(other):
        if j == len(other) or (i < len(one) and one[i].cell < other[j].cell):
            out[found] = one[i]
            i += 1
        elif i == len(one) or other[j].cell < one[i].cell:
            out[found] = other[j]
            j += 1
        else:
            out[found] = one[i]
            out[found].visits |= other[j].visits
            out[found].machines |= other[j].machines
            out[found].newest_ns = max(one[i].newest_ns, other[j].newest_ns)
            i += 1
            j += 1
        found += 1
    return found


@numba.njit(cache=True, nogil=True)
def moments(votes: Any, start: int, stop: int, out: Any) -> None:
    """Add to out (3, 256) sums of counts, counts times bin and counts times bin squared, of planes start to stop."""
    for i in range(len(votes)):
        plane, cell = votes[i].place // CELLS, votes[i].place % CELLS
        if start <= plane < stop:
            bin_, count = plane - start, np.float64(votes[i].count)
            out[0, cell] += count
            out[1, cell] += count * bin_
            out[2, cell] += count * bin_ * bin_
