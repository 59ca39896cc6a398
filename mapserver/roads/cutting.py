"""Smooths road lines and cuts them at the lattice, each edge by itself (compiled)."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from protocol.arrays import Bools, Floats, Ints

LATTICE_M = 25.0
SLIVER_M = 9.0  # shorter pieces join a neighbour [m]
LEAST_M = 3.0  # shorter edges are no segments [m]
SMOOTH = 4  # points on each side in the moving average; cells are 1 m wide


def cut(points: Floats, ends: Ints, nodes: Ints) -> tuple[Floats, Ints]:
    """Smooth and cut edges; arrays as in Network.

    Returns points, and pieces (m, 4): first and last point (shared with neighbours), nodes at both ends (-1: the edge
    continues).
    """
    line, pieces = np.empty_like(points), np.empty((len(points), 4), np.int64)
    return line, pieces[: _cut(points, ends, nodes, line, pieces)].copy()


@numba.njit(cache=True, nogil=True)
def _cut(points: Any, ends: Any, nodes: Any, line: Any, pieces: Any) -> int:
    """Returns the number of pieces."""
    bounds = np.empty(len(points) + 2, np.int64)
    along = np.empty(len(points))
    used = 0
    for edge in range(len(ends) - 1):
        first, end = ends[edge], ends[edge + 1]
        own = line[first:end]
        closed = bool(points[first, 0] == points[end - 1, 0] and points[first, 1] == points[end - 1, 1])
        _smooth(points[first:end], closed, own)
        if closed:
            _begin_at_cut(own)
        along[0] = 0.0
        for i in range(1, len(own)):
            along[i] = along[i - 1] + _distance(own[i], own[i - 1])
        if along[len(own) - 1] < LEAST_M:
            continue
        count = _without_slivers(bounds, _bounds(own, bounds), along)
        ring = closed and nodes[edge, 0] == nodes[edge, 1]
        for i in range(count - 1):
            pieces[used, 0], pieces[used, 1] = first + bounds[i], first + bounds[i + 1]
            pieces[used, 2] = nodes[edge, 0] if i == 0 and not ring else -1
            pieces[used, 3] = nodes[edge, 1] if i == count - 2 and not ring else -1
            used += 1
    return used


@numba.njit(cache=True, nogil=True)
def _distance(one: Any, other: Any) -> float:
    dx, dy = one[0] - other[0], one[1] - other[1]
    return float(np.sqrt(dx * dx + dy * dy))


@numba.njit(cache=True, nogil=True)
def _smooth(points: Any, closed: bool, out: Any) -> None:  # noqa: FBT001
    """Moving average; the ends of an open line stay fixed."""
    last = len(points) - 1
    k = min(SMOOTH, last - 1)
    for i in range(last + 1):
        for axis in range(2):
            total = 0.0
            for step in range(-k, k + 1):
                at = i + step
                if 0 <= at <= last:
                    total += points[at, axis]
                elif closed:
                    total += points[at + last if at < 0 else at - last, axis]
                elif at < 0:  # mirrored at the end
                    total += 2 * points[0, axis] - points[-at, axis]
                else:
                    total += 2 * points[last, axis] - points[2 * last - at, axis]
            out[i, axis] = total / (2 * k + 1) if k > 0 else points[i, axis]
    if closed:
        out[last] = out[0]
    else:  # bit-identical, because other edges end here too
        out[0], out[last] = points[0], points[last]


@numba.njit(cache=True, nogil=True)
def _is_cut(line: Any, i: int) -> bool:
    column = np.floor(line[i, 0] / LATTICE_M) != np.floor(line[i - 1, 0] / LATTICE_M)
    row = np.floor(line[i, 1] / LATTICE_M) != np.floor(line[i - 1, 1] / LATTICE_M)
    return bool(column or row)


@numba.njit(cache=True, nogil=True)
def _begin_at_cut(line: Any) -> None:
    for start in range(1, len(line)):
        if _is_cut(line, start):
            before = line.copy()
            for i in range(len(line)):
                for axis in range(2):
                    line[i, axis] = before[(start + i) % (len(line) - 1), axis]
            return


@numba.njit(cache=True, nogil=True)
def _bounds(line: Any, bounds: Any) -> int:
    """Fill in first points of pieces and the last point of all; returns the number of bounds."""
    bounds[0], count = 0, 1
    for i in range(1, len(line) - 1):
        if _is_cut(line, i):
            bounds[count] = i
            count += 1
    bounds[count] = len(line) - 1
    return count + 1


@numba.njit(cache=True, nogil=True)
def _without_slivers(bounds: Any, count: int, along: Any) -> int:
    """Join slivers to their shorter neighbours, shortest first; returns the number of bounds."""
    while count > 2:
        shortest = 0
        for i in range(1, count - 1):
            if along[bounds[i + 1]] - along[bounds[i]] < along[bounds[shortest + 1]] - along[bounds[shortest]]:
                shortest = i
        if along[bounds[shortest + 1]] - along[bounds[shortest]] >= SLIVER_M:
            break
        before = along[bounds[shortest]] - along[bounds[shortest - 1]] if shortest else np.inf
        after = np.inf
        if shortest + 2 < count:
            after = along[bounds[shortest + 2]] - along[bounds[shortest + 1]]
        gone = shortest if before <= after else shortest + 1
        for i in range(gone, count - 1):
            bounds[i] = bounds[i + 1]
        count -= 1
    return count


@numba.njit(cache=True, nogil=True)
def gathered(points: Floats, first: Ints, last: Ints, back: Bools) -> tuple[Floats, Ints, Floats]:
    """Concatenate lines, reversed where `back`: points (n, 2), first point of each (k + 1,), lengths (k,) [m]."""
    ends = np.zeros(len(first) + 1, np.int64)
    for k in range(len(first)):
        ends[k + 1] = ends[k] + last[k] - first[k] + 1
    out, lengths = np.empty((ends[-1], 2)), np.zeros(len(first))
    for k in range(len(first)):
        for i in range(last[k] - first[k] + 1):
            at = last[k] - i if back[k] else first[k] + i
            out[ends[k] + i, 0], out[ends[k] + i, 1] = points[at, 0], points[at, 1]
            if i:
                lengths[k] += _distance(out[ends[k] + i], out[ends[k] + i - 1])
    return out, ends, lengths
