"""Packing and merging of pages in numba. Imported only where numba is installed; pages.py has the same in numpy."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import CELLS, COUNT_MAX


@numba.njit(cache=True, nogil=True)
def take(counts: Any, place: Any, count: Any) -> int:
    """Move what is not zero in counts (COUNTS * 256,) to place, count; returns how many there are."""
    found = 0
    for plane in range(len(counts) // CELLS):
        cells = counts[plane * CELLS :][:CELLS]
        any_ = np.uint32(0)
        for i in range(CELLS):  # most planes are empty, which vector instructions see at once
            any_ |= cells[i]
        if any_ == 0:
            continue
        for i in range(CELLS):
            if cells[i]:
                place[found], count[found] = plane * CELLS + i, cells[i]
                cells[i] = 0
                found += 1
    return found


@numba.njit(cache=True, nogil=True)
def add(one: Any, other: Any, place: Any, count: Any) -> int:
    """Merge two arrays of votes into place, count, in the order of places; returns how many there are."""
    i, j, found = 0, 0, 0
    while i < len(one) or j < len(other):
        if j == len(other) or (i < len(one) and one[i].place < other[j].place):
            place[found], count[found] = one[i].place, one[i].count
            i += 1
        elif i == len(one) or other[j].place < one[i].place:
            place[found], count[found] = other[j].place, other[j].count
            j += 1
        else:
            place[found] = one[i].place
            count[found] = min(np.uint64(one[i].count) + np.uint64(other[j].count), np.uint64(COUNT_MAX))
            i += 1
            j += 1
        found += 1
    return found
