"""Loops over pages, compiled by numba.

They write votes twice, as NARROW and as WIDE records: which of them fits is known when all are written.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNT_MAX


@numba.njit(cache=True, nogil=True)
def take_votes(counts: Any, planes: Any, newest_ns: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Move what is not zero in counts (COUNTS, 256) to votes; returns how many there are, and the largest count.

    planes (COUNTS,): which of them have been written to; most have not, and are not touched.
    """
    n, largest = 0, np.uint32(0)
    touched = np.flatnonzero(newest_ns)
    for plane in np.flatnonzero(planes):
        cells = counts[plane]
        planes[plane] = False
        for i in touched:
            if cells[i]:
                narrow[n].place, narrow[n].count = plane * CELLS + i, cells[i]
                wide[n].place, wide[n].count = plane * CELLS + i, cells[i]
                largest = max(largest, cells[i])
                cells[i] = 0
                n += 1
    return n, int(largest)


@numba.njit(cache=True, nogil=True)
def take_cells(bitmaps: Any, newest_ns: Any, out: Any) -> int:
    """Move bitmaps (2, 256) and stamps (256,) of touched cells to cells; returns how many there are."""
    n = 0
    for i in range(CELLS):
        if newest_ns[i]:
            out[n].cell, out[n].newest_ns = i, newest_ns[i]
            out[n].visits, out[n].machines = bitmaps[0, i], bitmaps[1, i]
            bitmaps[0, i] = bitmaps[1, i] = newest_ns[i] = 0
            n += 1
    return n


@numba.njit(cache=True, nogil=True)
def pick_votes(votes: Any, chosen: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Votes of the chosen cells (256,); returns how many there are, and the largest count."""
    n, largest = 0, np.uint32(0)
    for i in range(len(votes)):
        if chosen[votes[i].place % CELLS]:
            narrow[n].place, narrow[n].count = votes[i].place, votes[i].count
            wide[n].place, wide[n].count = votes[i].place, votes[i].count
            largest = max(largest, np.uint32(votes[i].count))
            n += 1
    return n, int(largest)


@numba.njit(cache=True, nogil=True)
def pick_cells(cells: Any, chosen: Any, out: Any) -> int:
    """The chosen cells; returns how many there are."""
    n = 0
    for i in range(len(cells)):
        if chosen[cells[i].cell]:
            out[n] = cells[i]
            n += 1
    return n


@numba.njit(cache=True, nogil=True)
def add_votes(one: Any, other: Any, narrow: Any, wide: Any) -> tuple[int, int]:
    """Merge votes in the order of places, saturated; returns how many there are, and the largest count."""
    i, j, n, largest = 0, 0, 0, np.uint64(0)
    while i < len(one) or j < len(other):
        from_one = j == len(other) or (i < len(one) and one[i].place <= other[j].place)
        from_other = i == len(one) or (j < len(other) and other[j].place <= one[i].place)
        place = one[i].place if from_one else other[j].place
        count = np.uint64(0)
        if from_one:
            count += np.uint64(one[i].count)
            i += 1
        if from_other:
            count += np.uint64(other[j].count)
            j += 1
        count = min(count, np.uint64(COUNT_MAX))
        narrow[n].place, narrow[n].count = place, count
        wide[n].place, wide[n].count = place, count
        largest = max(largest, count)
        n += 1
    return n, int(largest)


@numba.njit(cache=True, nogil=True)
def add_cells(one: Any, other: Any, out: Any) -> int:
    """Merge cells in the order of their numbers; returns how many there are."""
    i, j, n = 0, 0, 0
    while i < len(one) or j < len(other):
        if j == len(other) or (i < len(one) and one[i].cell < other[j].cell):
            out[n] = one[i]
            i += 1
        elif i == len(one) or other[j].cell < one[i].cell:
            out[n] = other[j]
            j += 1
        else:
            out[n] = one[i]
            out[n].visits |= other[j].visits
            out[n].machines |= other[j].machines
            out[n].newest_ns = max(one[i].newest_ns, other[j].newest_ns)
            i += 1
            j += 1
        n += 1
    return n


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
