"""Votes into hot blocks. The integer weights of one sample sum exactly to its weight, with and without numba."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.open_blocks import FREE, Hot, code_of
from mapserver.evidence.votes import TABLE, TABLE_LAST, TABLE_PER_UNIT, FoldConfig, Votes, is_foldable, prepare
from protocol.arrays import Ints, Table
from protocol.site.geometry import BLOCK_CELLS

WEIGHT_SHIFT = 32  # shares of a weight are exact to 2**-32 before they are rounded down


class Kernel(Protocol):
    """Adds samples of one machine to hot blocks, and opens those that it needs."""

    def __call__(self, rows: Table, machine: str, cell_m: float, config: FoldConfig, hot: Hot) -> int:
        """Fold the rows that know their place well enough; returns how many.

        Raises NoRoom where more blocks would have to be opened than there is room for: nothing was folded then.
        """
        ...


def kernel(name: str) -> Kernel:
    """Return the kernel of that name; `auto` is numba where it is installed."""
    if name == "numpy":
        return fold_numpy
    try:
        from mapserver.evidence.fold_numba import fold_numba
    except ImportError:
        if name == "numba":
            raise
        return fold_numpy
    return fold_numba


def fold_numpy(rows: Table, machine: str, cell_m: float, config: FoldConfig, hot: Hot) -> int:
    """Fold without numba: the same integers, one stencil cell at a time over all samples."""
    votes = prepare(rows[is_foldable(rows, config)], machine, cell_m, config)
    corner = (votes.middle - votes.reach[:, None]) // BLOCK_CELLS
    codes = _codes(votes, corner)
    unique, inverse = np.unique(codes, return_inverse=True)
    found = hot.slots_of(unique.tolist())
    if (found == FREE).any():
        hot.open(unique[found == FREE].tolist())
        found = hot.slots_of(unique.tolist())
    slots = found[inverse].reshape(codes.shape)
    for offset_y, offset_x, share in _stencils(votes):
        hit = np.flatnonzero(share)
        column, row = votes.middle[hit, 0] + offset_x, votes.middle[hit, 1] + offset_y
        slot = slots[hit, (row >> 4) - corner[hit, 1], (column >> 4) - corner[hit, 0]]
        _add_votes(votes, hit, slot, (row & 15) * 16 + (column & 15), share[hit], hot)
    return len(votes.weight)


def _codes(votes: Votes, corner: Ints) -> Ints:
    """Codes (n, k, k) of all blocks that the stencils touch; where one touches fewer, its last block again."""
    last = (votes.middle + votes.reach[:, None]) // BLOCK_CELLS
    steps = np.arange(int((last - corner).max(initial=0)) + 1)
    x = np.minimum(corner[:, 0, None, None] + steps[None, None, :], last[:, 0, None, None])
    y = np.minimum(corner[:, 1, None, None] + steps[None, :, None], last[:, 1, None, None])
    return code_of(votes.bucket[:, None, None], x, y)


def _stencils(votes: Votes) -> list[tuple[int, int, Ints]]:
    """Return offset_y, offset_x from the middle, and every sample's integer share of its weight there.

    What rounding down leaves over goes to the middle.
    """
    reach = int(votes.reach.max(initial=0))
    offsets = [(dy, dx) for dy in range(-reach, reach + 1) for dx in range(-reach, reach + 1)]
    raw = np.stack([_raw_weight(votes, dy, dx) for dy, dx in offsets])
    factor = (votes.weight << WEIGHT_SHIFT) // np.maximum(raw.sum(axis=0), 1)
    share = (raw * factor) >> WEIGHT_SHIFT
    share[len(offsets) // 2] += votes.weight - share.sum(axis=0)
    return [(dy, dx, share[k]) for k, (dy, dx) in enumerate(offsets)]


def _raw_weight(votes: Votes, dy: int, dx: int) -> Ints:
    x = (votes.middle[:, 0] + dx + 0.5) - votes.place[:, 0]
    y = (votes.middle[:, 1] + dy + 0.5) - votes.place[:, 1]
    a, b, c = votes.inverse.T
    d2 = (a * x + b * y) * x + c * y * y
    inside = (abs(dx) <= votes.reach) & (abs(dy) <= votes.reach)
    place = np.minimum(d2 * TABLE_PER_UNIT, TABLE_LAST).astype(np.int64)
    return np.where(inside, TABLE[place], 0)


def _add_votes(votes: Votes, hit: Ints, slot: Ints, cell: Ints, weight: Ints, hot: Hot) -> None:
    """Add the weights of the samples `hit` to one cell each."""
    for part, first in enumerate((ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start)):
        votes_for = votes.bins[hit, part] >= 0
        at, where, bins = slot[votes_for], cell[votes_for], first + votes.bins[hit, part][votes_for]
        upper = weight[votes_for] * votes.shares[hit, part][votes_for] // ev.SHARE_ONE
        _add(hot, at, bins, where, weight[votes_for] - upper)
        _add(hot, at, bins + 1, where, upper)
    _add(hot, slot, ev.HEADING.start + votes.sector[hit], cell, weight)
    for which in (ev.VISITS, ev.MACHINES):
        np.bitwise_or.at(hot.bitmaps, (slot, np.full_like(slot, which), cell), votes.bits[hit, which])
    np.maximum.at(hot.newest, (slot, cell), votes.stamp_ns[hit])


def _add(hot: Hot, slot: Ints, plane: Ints, cell: Ints, weight: Ints) -> None:
    np.add.at(hot.counts, (slot, plane, cell), weight.astype(np.uint32))
    hot.planes[slot, plane] = True
