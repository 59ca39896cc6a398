"""Lines of cells as a graph: ends and junctions, and the chains of cells between them, compiled.

A diagonal step counts only where no two straight ones lead the same way, so that the corners of lines are no junctions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from protocol.arrays import Ints

# Four straight steps, and four diagonal ones, each between the straight ones beside it in their order: row, column.
_STEPS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)])
_ROW_BITS = 32


class Chains(NamedTuple):
    """Chains of cells. cells: their numbers, one chain behind the other; ends: (k + 1,) where each begins.

    A chain runs from the cell of lower number to that of the higher one; a ring without a junction begins and ends with
    its lowest cell. degree: (n,) neighbours of each cell.
    """

    cells: Ints
    ends: Ints
    degree: Ints


def chains(places: Ints) -> Chains:
    """Chains of cells (n, 2), rows and columns, sorted by these."""
    links, degree = neighbours(places)
    cells, ends, used, count = np.empty(2 * len(places) + 16, np.int64), np.zeros(len(places) * 4 + 2, np.int64), 0, 0
    while True:
        used, count = _trace(links, degree, cells, ends)
        if used <= len(cells):
            break
        cells = np.empty(used, np.int64)
    return Chains(cells[:used].copy(), ends[: count + 1].copy(), degree)


@numba.njit(cache=True, nogil=True)
def neighbours(places: Any) -> tuple[Any, Any]:
    """Numbers (n, 8) of the cells beside each cell (n, 2) [row, column], sorted by these, -1 for none; and how many."""
    count = len(places)
    keys = (places[:, 0] << _ROW_BITS) + places[:, 1]
    links = np.full((count, 8), -1, np.int64)
    for k in range(8):
        dy, dx = _STEPS[k, 0], _STEPS[k, 1]
        offset, at = (dy << _ROW_BITS) + dx, 0
        for i in range(count):  # what is sought grows as i does, so that one run through all is enough
            sought = keys[i] + offset
            while at < count and keys[at] < sought:
                at += 1
            if at < count and keys[at] == sought:
                links[i, k] = at
    for i in range(count):
        for k in range(4):
            if links[i, k] >= 0 or links[i, (k + 1) % 4] >= 0:
                links[i, 4 + k] = -1
    degree = np.zeros(count, np.int64)
    for i in range(count):
        for k in range(8):
            degree[i] += links[i, k] >= 0
    return links, degree


@numba.njit(cache=True, nogil=True)
def _trace(links: Any, degree: Any, cells: Any, ends: Any) -> tuple[int, int]:
    """Fill cells and ends; returns how many cells there are, whether or not they had room, and how many chains."""
    seen = degree != 2
    used, count = _trace_between(links, degree, seen, cells, ends)
    return _trace_rings(links, degree, seen, cells, ends, used, count)


@numba.njit(cache=True, nogil=True)
def _trace_between(links: Any, degree: Any, seen: Any, cells: Any, ends: Any) -> tuple[int, int]:
    """Chains between ends and junctions, each from the end of lower number; marks as seen what is in them."""
    used, count = 0, 0
    for place in range(8 * len(links)):
        start, second = place // 8, links[place // 8, place % 8]
        if degree[start] == 2 or second < 0:
            continue
        first, used = used, _follow(links, degree, start, second, cells, used)
        if used > len(cells):
            continue
        last, before = cells[used - 1], cells[used - 2]
        if last < start or (last == start and before < second):
            used = first  # it is followed from its other end
            continue
        for i in range(first, used):
            seen[cells[i]] = True
        count += 1
        ends[count] = used
    return used, count


@numba.njit(cache=True, nogil=True)
def _trace_rings(links: Any, degree: Any, seen: Any, cells: Any, ends: Any, used: int, count: int) -> tuple[int, int]:
    """Chains that meet no end and no junction, from their lowest cell to its first neighbour."""
    for start in range(len(links)):
        if seen[start]:
            continue
        second = -1
        for k in range(7, -1, -1):
            if links[start, k] >= 0:
                second = links[start, k]
        first, used = used, _follow(links, degree, start, second, cells, used)
        for i in range(first, min(used, len(cells))):
            seen[cells[i]] = True
        count += 1
        ends[count] = used
    return used, count


@numba.njit(cache=True, nogil=True)
def _follow(links: Any, degree: Any, start: int, second: int, cells: Any, used: int) -> int:
    """Note a chain from `start` on by way of `second`, up to the next cell that is no part of a line, or to `start`."""
    before, here = start, second
    if used < len(cells):
        cells[used] = start
    used += 1
    while True:
        if used < len(cells):
            cells[used] = here
        used += 1
        if degree[here] != 2 or here == start:
            return used
        for k in range(8):
            after = links[here, k]
            if after >= 0 and after != before:
                before, here = here, after
                break
