"""Thinning: a mask of roads becomes lines of single cells, 8-connected, with the same topology.

Algorithm A1 of Guo and Hall, "Parallel thinning with two-subiteration algorithms", Communications of the ACM 32 (1989).
The number of rounds is fixed, so that a cell depends on nothing farther than `REACH` cells; what is wider stays thick.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from protocol.arrays import Bools

ROUNDS = 8  # ridges are five cells wide, and where several cross some more
REACH = 2 * ROUNDS + 1


def thinned(mask: Bools) -> Bools:
    """The lines (rows, columns) of a mask; nothing lies outside of it. Small holes are closed first."""
    padded = np.pad(mask, 1).astype(np.uint8)
    _close_holes(padded)
    _thin(padded)
    return np.asarray(padded[1:-1, 1:-1], np.bool_)


@numba.njit(cache=True, nogil=True)
def _close_holes(image: Any) -> None:
    """Set cells whose four neighbours are set: a hole of one cell would become a ring."""
    rows, columns = image.shape
    before = image.copy()
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            if before[y - 1, x] and before[y + 1, x] and before[y, x - 1] and before[y, x + 1]:
                image[y, x] = 1


@numba.njit(cache=True, nogil=True)
def _thin(image: Any) -> None:
    places = np.argwhere(image)
    removed = np.empty(len(places), np.int64)
    last = 0  # half that removed any
    for turn in range(2 * ROUNDS):
        gone = 0
        for i in range(len(places)):
            y, x = places[i]
            if image[y, x] and _is_removable(image, y, x, turn % 2):
                removed[gone] = i
                gone += 1
        for k in range(gone):
            y, x = places[removed[k]]
            image[y, x] = 0
        if gone:
            last = turn
        elif turn > last:  # both halves of a round changed nothing, so nothing ever will
            break


@numba.njit(cache=True, nogil=True)
def _is_removable(image: Any, y: int, x: int, turn: int) -> bool:
    """Whether a cell may go in this half of a round; neighbours p2 ... p9 clockwise from above."""
    p2, p3, p4, p5 = image[y - 1, x], image[y - 1, x + 1], image[y, x + 1], image[y + 1, x + 1]
    p6, p7, p8, p9 = image[y + 1, x], image[y + 1, x - 1], image[y, x - 1], image[y - 1, x - 1]
    crossings = ((1 - p2) & (p3 | p4)) + ((1 - p4) & (p5 | p6)) + ((1 - p6) & (p7 | p8)) + ((1 - p8) & (p9 | p2))
    if crossings != 1:
        return False
    pairs = min(
        (p9 | p2) + (p3 | p4) + (p5 | p6) + (p7 | p8),
        (p2 | p3) + (p4 | p5) + (p6 | p7) + (p8 | p9),
    )
    if pairs < 2 or pairs > 3:
        return False
    if turn == 0:
        return bool(((p2 | p3 | (1 - p5)) & p4) == 0)
    return bool(((p6 | p7 | (1 - p9)) & p8) == 0)
