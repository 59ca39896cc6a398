"""The fold kernel in numba. Imported only where numba is installed; `fold.fold_numpy` gives the same bits."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mapserver import evidence as ev
from mapserver.votes import TABLE, TABLE_MAX_D2, TABLE_PER_UNIT, Votes
from protocol.arrays import Ints

_FIRST = np.array([ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start])
_HEADING, _WEIGHT, _ONE, _MAX = ev.HEADING.start, ev.WEIGHT, ev.SHARE_ONE, int(ev.COUNT_MAX)


def fold_numba(
    votes: Votes,
    slots: Ints,
    corner: Ints,
    counts: NDArray[np.uint32],
    bitmaps: NDArray[np.uint64],
    newest: Ints,
) -> None:
    """Fold votes; see `fold.Kernel`."""
    edge = int(votes.size.max(initial=0))
    raw = np.empty((edge, edge), np.int64)
    v = votes
    arrays = (v.place, v.inverse, v.origin, v.size, v.weight, v.bins, v.shares, v.sector, v.stamp_ns, v.bits)
    _fold(*arrays, slots, corner, counts, bitmaps, newest, raw)


@numba.njit(cache=True)
def _add(counts: Any, block: int, cell: int, index: int, weight: int) -> None:
    total = np.int64(counts[block, cell, index]) + weight
    counts[block, cell, index] = min(total, _MAX)


@numba.njit(cache=True)
def _stencil(place: Any, inverse: Any, origin: Any, size: int, raw: Any) -> tuple[int, int, int]:
    """Fill raw[:size, :size] with table weights; return their sum and the first largest place."""
    total, best, best_y, best_x = 0, -1, 0, 0
    for dy in range(size):
        y = origin[1] + dy + 0.5 - place[1]
        for dx in range(size):
            x = origin[0] + dx + 0.5 - place[0]
            d2 = inverse[0] * x * x + inverse[1] * x * y + inverse[2] * y * y
            weight = TABLE[int(d2 * TABLE_PER_UNIT)] if d2 <= TABLE_MAX_D2 else 0
            raw[dy, dx] = weight
            total += weight
            if weight > best:
                best, best_y, best_x = weight, dy, dx
    if total == 0:  # the cell is much larger than the spread: all of it stays where the sample is
        best_y = best_x = size // 2
    return total, best_y, best_x


@numba.njit(cache=True)
def _fold(
    place: Any,
    inverse: Any,
    origin: Any,
    size: Any,
    weight: Any,
    bins: Any,
    shares: Any,
    sector: Any,
    stamp_ns: Any,
    bits: Any,
    slots: Any,
    corner: Any,
    counts: Any,
    bitmaps: Any,
    newest: Any,
    raw: Any,
) -> None:
    for k in range(len(weight)):
        total, best_y, best_x = _stencil(place[k], inverse[k], origin[k], size[k], raw)
        rest = weight[k]
        for dy in range(size[k]):
            for dx in range(size[k]):
                raw[dy, dx] = raw[dy, dx] * weight[k] // max(total, 1)
                rest -= raw[dy, dx]
        raw[best_y, best_x] += rest
        for dy in range(size[k]):
            row = origin[k, 1] + dy
            for dx in range(size[k]):
                share = raw[dy, dx]
                if share == 0:
                    continue
                column = origin[k, 0] + dx
                block = slots[k, (row >> 4) - corner[k, 1], (column >> 4) - corner[k, 0]]
                cell = (row & 15) * 16 + (column & 15)
                for part in range(3):
                    if bins[k, part] >= 0:
                        upper = share * shares[k, part] // _ONE
                        _add(counts, block, cell, _FIRST[part] + bins[k, part], share - upper)
                        _add(counts, block, cell, _FIRST[part] + bins[k, part] + 1, upper)
                _add(counts, block, cell, _HEADING + sector[k], share)
                _add(counts, block, cell, _WEIGHT, share)
                bitmaps[block, cell, 0] |= bits[k, 0]
                bitmaps[block, cell, 1] |= bits[k, 1]
                newest[block, cell] = max(newest[block, cell], stamp_ns[k])
