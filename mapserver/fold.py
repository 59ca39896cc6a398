"""Votes into the grid. The integer weights of one sample sum exactly to its weight, with and without numba."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapserver import evidence as ev
from mapserver.votes import TABLE, TABLE_MAX_D2, TABLE_PER_UNIT, Votes
from protocol.arrays import Bools, Ints

# A kernel adds votes into counts (slots, 256, COUNTS), bitmaps (slots, 256, 2), newest (slots, 256).
# slots: (n, k, k) slot of each block that a stencil touches; corner: (n, 2) block column and row of slots[:, 0, 0].
Kernel = Callable[[Votes, Ints, Ints, NDArray[np.uint32], NDArray[np.uint64], Ints], None]


def kernel(name: str) -> Kernel:
    """Return the kernel of that name; `auto` is numba where it is installed."""
    if name == "numpy":
        return fold_numpy
    try:
        from mapserver.fold_numba import fold_numba
    except ImportError:
        if name == "numba":
            raise
        return fold_numpy
    return fold_numba


def fold_numpy(
    votes: Votes,
    slots: Ints,
    corner: Ints,
    counts: NDArray[np.uint32],
    bitmaps: NDArray[np.uint64],
    newest: Ints,
) -> None:
    """Fold without numba: the same integers, one stencil cell at a time over all samples."""
    for offset_y, offset_x, share in _stencils(votes):
        hit = np.flatnonzero(share)
        column, row = votes.origin[hit, 0] + offset_x, votes.origin[hit, 1] + offset_y
        block = slots[hit, (row >> 4) - corner[hit, 1], (column >> 4) - corner[hit, 0]]
        cell = (row & 15) * 16 + (column & 15)
        weight = share[hit]
        for part, first in enumerate((ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start)):
            voting = votes.bins[hit, part] >= 0
            upper = weight * votes.shares[hit, part] // ev.SHARE_ONE
            index = first + votes.bins[hit, part]
            _add(counts, block, cell, index, weight - upper, voting)
            _add(counts, block, cell, index + 1, upper, voting)
        everyone = np.ones(len(hit), np.bool_)
        _add(counts, block, cell, ev.HEADING.start + votes.sector[hit], weight, everyone)
        _add(counts, block, cell, np.full(len(hit), ev.WEIGHT), weight, everyone)
        np.bitwise_or.at(bitmaps, (block, cell), votes.bits[hit])
        np.maximum.at(newest, (block, cell), votes.stamp_ns[hit])


def _stencils(votes: Votes) -> list[tuple[int, int, Ints]]:
    """Return offset_y, offset_x and every sample's integer share of its weight there."""
    edge = int(votes.size.max(initial=0))
    offsets = [(dy, dx) for dy in range(edge) for dx in range(edge)]
    raw = np.stack([_raw_weight(votes, dy, dx) for dy, dx in offsets]) if offsets else np.zeros((0, 0), np.int64)
    total = raw.sum(axis=0)
    lost = total == 0  # the cell is much larger than the spread: all of it stays where the sample is
    middle = (votes.size // 2) * edge + votes.size // 2
    raw[middle[lost], np.flatnonzero(lost)] = 1
    share = raw * votes.weight // np.maximum(total, 1)
    share[raw.argmax(axis=0), np.arange(len(votes.weight))] += votes.weight - share.sum(axis=0)
    return [(dy, dx, share[k]) for k, (dy, dx) in enumerate(offsets)]


def _raw_weight(votes: Votes, dy: int, dx: int) -> Ints:
    x = votes.origin[:, 0] + dx + 0.5 - votes.place[:, 0]
    y = votes.origin[:, 1] + dy + 0.5 - votes.place[:, 1]
    d2 = votes.inverse[:, 0] * x * x + votes.inverse[:, 1] * x * y + votes.inverse[:, 2] * y * y
    inside = (d2 <= TABLE_MAX_D2) & (dx < votes.size) & (dy < votes.size)
    return np.where(inside, TABLE[np.where(inside, d2 * TABLE_PER_UNIT, 0).astype(np.int64)], 0)


def _add(counts: NDArray[np.uint32], block: Ints, cell: Ints, index: Ints, weight: Ints, which: Bools) -> None:
    """Add with saturation: the exact sum of this batch and what is there, limited to COUNT_MAX."""
    where = np.ravel_multi_index((block[which], cell[which], index[which]), counts.shape)
    unique, inverse = np.unique(where, return_inverse=True)
    total = np.zeros(len(unique), np.int64)
    np.add.at(total, inverse, weight[which])
    place = np.unravel_index(unique, counts.shape)
    counts[place] = np.minimum(counts[place].astype(np.int64) + total, ev.COUNT_MAX).astype(np.uint32)
