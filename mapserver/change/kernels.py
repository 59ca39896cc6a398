"""Histograms of votes per page and cell, compiled.

Votes are packed as in mapserver/evidence/pages.py: the place (bin * 256 + cell) in the lower 16 bits, the count above.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS


@numba.njit(cache=True, nogil=True)
def differ(votes: Any, ends: Any, start: int, stop: int, least: float, most: float) -> Any:
    """Cells (256,) whose pages differ by more than `most` bins, in the mean of their votes or in its spread.

    ends (pages,): of each page's votes. start, stop: the bins of one value. Pages with at most `least` of votes for a
    cell do not count.
    """
    low, high = np.full((2, CELLS), np.inf), np.full((2, CELLS), -np.inf)
    sums = np.zeros((3, CELLS))
    i = 0
    for end in ends:
        sums[:] = 0
        while i < end:
            place, count = int(votes[i] & np.uint64(0xFFFF)), float(votes[i] >> np.uint64(16))
            bin_, cell = place // CELLS - start, place % CELLS
            if 0 <= bin_ < stop - start:
                sums[0, cell] += count
                sums[1, cell] += count * bin_
                sums[2, cell] += count * bin_ * bin_
            i += 1
        for cell in range(CELLS):
            weight = sums[0, cell]
            if weight > least:
                mean = sums[1, cell] / weight
                spread = np.sqrt(max(sums[2, cell] / weight - mean * mean, 0.0))
                low[0, cell], high[0, cell] = min(low[0, cell], mean), max(high[0, cell], mean)
                low[1, cell], high[1, cell] = min(low[1, cell], spread), max(high[1, cell], spread)
    return (high[0] - low[0] > most) | (high[1] - low[1] > most)


@numba.njit(cache=True, nogil=True)
def histograms(votes: Any, ends: Any, start: int, stop: int, columns: Any, out: Any) -> None:
    """Fill out (pages, bins, columns) with the votes of some cells; columns (256,): of each cell, -1 for none."""
    i = 0
    for page in range(len(ends)):
        while i < ends[page]:
            place = int(votes[i] & np.uint64(0xFFFF))
            bin_, column = place // CELLS - start, columns[place % CELLS]
            if 0 <= bin_ < stop - start and column >= 0:
                out[page, bin_, column] = float(votes[i] >> np.uint64(16))
            i += 1
