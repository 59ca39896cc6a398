"""Histograms of votes by page and cell (compiled).

Votes as in mapserver/evidence/pages.py: place (bin * 256 + cell) in the lower 16 bits, count above.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS

LEAST = 1e-9  # lower bound of divisors


@numba.njit(cache=True, nogil=True)
def differ(votes: Any, ends: Any, start: int, stop: int, least: float, most: float) -> Any:
    """Cells (256,) whose pages differ by more than `most` bins in mean or spread.

    ends (pages,): of each page's votes. start, stop: bins of one value. Pages with at most `least` votes do not count.
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
    """Fill out (pages, bins, columns); columns (256,): of each cell, -1 for none."""
    i = 0
    for page in range(len(ends)):
        while i < ends[page]:
            place = int(votes[i] & np.uint64(0xFFFF))
            bin_, column = place // CELLS - start, columns[place % CELLS]
            if 0 <= bin_ < stop - start and column >= 0:
                out[page, bin_, column] = float(votes[i] >> np.uint64(16))
            i += 1


@numba.njit(cache=True, nogil=True)
def sums(votes: Any, start: int, stop: int) -> Any:
    """Votes (bins, 256) of all pages."""
    out = np.zeros((stop - start, CELLS))
    for i in range(np.uint64(len(votes))):
        place = votes[i] & np.uint64(0xFFFF)
        bin_ = np.int64(place >> np.uint64(8)) - start
        if 0 <= bin_ < stop - start:
            out[bin_, place & np.uint64(CELLS - 1)] += float(votes[i] >> np.uint64(16))
    return out


@numba.njit(cache=True, nogil=True)
def weights(votes: Any, ends: Any, start: int, stop: int) -> Any:
    """Votes (pages, 256) of bins start to stop; ends (pages,): of each page's votes."""
    out = np.zeros((len(ends), CELLS))
    i = 0
    for page in range(len(ends)):
        while i < ends[page]:
            place = int(votes[i] & np.uint64(0xFFFF))
            if start <= place // CELLS < stop:
                out[page, place % CELLS] += float(votes[i] >> np.uint64(16))
            i += 1
    return out


@numba.njit(cache=True, nogil=True)
def medians(votes: Any) -> Any:
    """Median (cells,) of histograms (bins, cells), interpolated, in bins; NaN without votes."""
    bins, cells = votes.shape
    out = np.full(cells, np.nan)
    for cell in range(cells):
        weight = 0.0
        for i in range(bins):
            weight += votes[i, cell]
        if weight > 0:
            out[cell] = _median(votes[:, cell] / max(weight, LEAST))
    return out


@numba.njit(cache=True, nogil=True)
def likeliest_cuts(votes: Any, first: Any, least: float) -> tuple[Any, Any, Any, Any]:
    """Page (cells,) before which votes are best cut in two kinds of ground, 0 for none.

    votes (pages, bins, cells) in metres; pages before first (cells,) do not count; each side needs `least` metres.
    Maximises the log-likelihood ratio: entropy of all votes minus that of both sides, weighted. Also returns total
    variation and medians of the histograms on both sides.
    """
    pages, bins, cells = votes.shape
    best = np.zeros(cells, np.int64)
    variation, medians_before, medians_after = np.zeros(cells), np.zeros(cells), np.zeros(cells)
    before, old, every = np.empty(bins), np.empty(bins), np.empty(bins)
    for cell in range(cells):
        every[:] = 0.0
        for page in range(first[cell], pages):
            for i in range(bins):
                every[i] += votes[page, i, cell]
        old[:] = before[:] = 0.0
        most = -np.inf
        for page in range(first[cell] + 1, pages):
            is_more = False
            for i in range(bins):
                old[i] += votes[page - 1, i, cell]
                is_more |= votes[page - 1, i, cell] > 0
            if not is_more:  # equal to the previous cut
                continue
            gain = _both_sides(old, every, least)
            if gain > most:
                most, best[cell] = gain, page
                before[:] = old
        if best[cell]:
            after = every - before
            before /= max(_sum(before), LEAST)
            after /= max(_sum(after), LEAST)
            for i in range(bins):
                variation[cell] += abs(before[i] - after[i])
            variation[cell] /= 2
            medians_before[cell], medians_after[cell] = _median(before), _median(after)
    return best, variation, medians_before, medians_after


@numba.njit(cache=True, nogil=True)
def _median(shares: Any) -> float:
    """Median of shares (bins,), in bins."""
    until, bin_ = shares[0], 0
    while until < 0.5 and bin_ < len(shares) - 1:
        bin_ += 1
        until += shares[bin_]
    median: float = bin_ + 0.5 - (until - 0.5) / max(shares[bin_], LEAST)
    return median


@numba.njit(cache=True, nogil=True)
def _sum(values: Any) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


@numba.njit(cache=True, nogil=True)
def _both_sides(old: Any, every: Any, least: float) -> Any:
    """Log-likelihood of a cut up to a constant of the cell; -inf if a side is too weak."""
    old_m, new_m, logs = 0.0, 0.0, 0.0
    for i in range(len(old)):
        new = every[i] - old[i]
        old_m += old[i]
        new_m += new
        if old[i] > 0:
            logs += old[i] * np.log(old[i])
        if new > 0:
            logs += new * np.log(new)
    if old_m < least or new_m < least:
        return -np.inf
    return logs - old_m * np.log(old_m) - new_m * np.log(new_m)
