"""The graph of roads, from lines of cells (compiled): ends, junctions, and the chains between them.

Pruning removes spurs, undriven bridges and overlong ends; close junctions are joined. All depends on places and metres,
never on an earlier graph. A diagonal step counts only if no two straight steps lead the same way, so corners are no
junctions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np

from mapserver.evidence.cells import WEIGHT_UNITS_PER_M, ZERO
from mapserver.roads.ridges import AXES
from mapserver.roads.skeleton import Skeleton
from protocol.arrays import AnyArray, Floats, Ints

SPUR_M = 10.0  # shorter dead ends are the width of a road [m]
LEAST_ROAD_M = 15.0  # least length of an isolated road: a machine and its position error [m]
JOIN_M = 6.0  # closer junctions are one, because crossing lines share cells [m]
ROUNDS = 8  # most rounds of pruning
# metres along a line in the 5 x 5 cells around a driven cell: a fifth of a pass
DRIVEN_M = 1.0
DRIVEN_SHARE = 0.7  # least share of an edge's cells that are driven
# A road ends where metres fall to this share of those so many cells farther in: half of the 5 x 5 cells lies beyond.
END_SHARE, INWARD = 0.45, 8
TANGENT = 4  # cells on each side that set a line's direction
# (row, column): straight steps, then diagonals, each between the straight ones of the same index
_STEPS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)])
_ROW_BITS = 32


@dataclass(frozen=True)
class Network:
    """Edges as lines. points: (n, 2) [m]; ends: (k + 1,) first points; nodes: (k, 2) at both ends, equal for a ring."""

    points: Floats
    ends: Ints
    nodes: Ints


def network(skeleton: Skeleton) -> Network:
    """Prune a skeleton and trace its graph."""
    places, metres = skeleton.places, skeleton.metres
    traced = chains(places)
    for _ in range(ROUNDS):
        gone = _superfluous(places, metres, *traced, skeleton.raster_m)
        if not gone.any():
            break
        places, metres = places[~gone], metres[~gone]
        traced = chains(places)
    return _lines(places, traced, skeleton.raster_m)


@numba.njit(cache=True, nogil=True)
def _superfluous(
    places: AnyArray, metres: AnyArray, cells: AnyArray, ends: AnyArray, degree: AnyArray, raster_m: float
) -> Any:
    """Which cells (n,) are no road; arguments as in Chains."""
    gone = degree == 0
    along = np.empty(len(cells), np.int64)
    for chain in range(len(ends) - 1):
        first, last = ends[chain], ends[chain + 1] - 1
        length_m, driven = 0.0, 0
        for at in range(first, last + 1):
            along[at] = _along(places, metres, cells, first, last, at)
            driven += along[at] >= DRIVEN_M * WEIGHT_UNITS_PER_M
            if at > first:
                length_m += _step(places[cells[at]], places[cells[at - 1]]) * raster_m
        loose_first, loose_last = degree[cells[first]] == 1, degree[cells[last]] == 1
        out = cells[first] == cells[last] and length_m < LEAST_ROAD_M
        if loose_first and loose_last:
            out = out or length_m < LEAST_ROAD_M
        elif loose_first or loose_last:
            out = out or length_m < SPUR_M
        out = out or (driven < DRIVEN_SHARE * (last + 1 - first) and length_m > JOIN_M)
        for at in range(first, last + 1):
            if out and degree[cells[at]] <= 2:
                gone[cells[at]] = True
        # undriven ends: the blur extends lines
        if loose_first:
            _trim(along, cells, first, last, ZERO + 1, gone)
        if loose_last:
            _trim(along, cells, first, last, ZERO - 1, gone)
    return gone


@numba.njit(cache=True, nogil=True)
def _step(one: AnyArray, other: AnyArray) -> float:
    return 1.4142135623730951 if abs(one[0] - other[0]) + abs(one[1] - other[1]) == 2 else 1.0


@numba.njit(cache=True, nogil=True)
def _trim(along: AnyArray, cells: AnyArray, first: int, last: int, step: int, gone: AnyArray) -> None:
    """Shorten a dead end, until its metres reach about half of those farther in."""
    at = first if step > 0 else last
    while first <= at + INWARD * step <= last and along[at] < END_SHARE * along[at + INWARD * step]:
        gone[cells[at]] = True
        at += step


@numba.njit(cache=True, nogil=True)
def _along(places: AnyArray, metres: AnyArray, cells: AnyArray, first: int, last: int, at: int) -> int:
    """Metres along a chain near one cell, in 1/4096 m."""
    before, after = places[cells[max(at - TANGENT, first)]], places[cells[min(at + TANGENT, last)]]
    turn = np.arctan2(float(after[0] - before[0]), float(after[1] - before[1]))
    axis = int(np.rint(turn * AXES / np.pi))
    own = metres[cells[at]]
    return int(own[(axis - 1) % AXES] + own[axis % AXES] + own[(axis + 1) % AXES])


def _lengths(places: Ints, cells: Ints, ends: Ints, raster_m: float) -> Floats:
    steps = np.abs(np.diff(places[cells], axis=0, prepend=places[cells[:1]]))
    step = np.where(steps.sum(axis=1) == 2, np.sqrt(2.0), 1.0)
    step[ends[:-1]] = 0.0
    return np.asarray(np.add.reduceat(step, ends[:-1]) * raster_m, np.float64)


def _lines(places: Ints, traced: Chains, raster_m: float) -> Network:
    """Join close junctions."""
    cells, ends, degree = traced
    if not len(cells):
        return Network(np.zeros((0, 2)), np.zeros(1, np.int64), np.zeros((0, 2), np.int64))
    first, last = cells[ends[:-1]], cells[ends[1:] - 1]
    short = (degree[first] > 2) & (degree[last] > 2) & (_lengths(places, cells, ends, raster_m) < JOIN_M)
    group = _joined(len(places), first[short], last[short])
    centre = np.stack([np.bincount(group, places[:, axis] * (degree > 2), len(places)) for axis in (1, 0)], axis=1)
    count = np.bincount(group, degree > 2, len(places))
    kept = ~(short & (group[first] == group[last]))
    xy = places[cells][:, ::-1] + 0.5
    for at, joins in ((ends[:-1], first), (ends[1:] - 1, last)):
        some = degree[joins] > 2
        joint = group[joins[some]]
        xy[at[some]] = centre[joint] / count[joint, None] + 0.5
    of_cell = np.repeat(kept, np.diff(ends))
    lengths = np.diff(ends)[kept]
    nodes = np.stack([group[first], group[last]], axis=1)[kept]
    return Network(xy[of_cell] * raster_m, np.concatenate([[0], np.cumsum(lengths)]), nodes)


@numba.njit(cache=True, nogil=True)
def _joined(count: int, one: AnyArray, other: AnyArray) -> AnyArray:
    """Lowest number (n,) of each connected group."""
    group = np.arange(count)
    for i in range(len(one)):
        a, b = one[i], other[i]
        while group[a] != a:
            a = group[a]
        while group[b] != b:
            b = group[b]
        group[max(a, b)] = min(a, b)
    for i in range(count):  # ascending: one step is enough
        group[i] = group[group[i]]
    return group


class Chains(NamedTuple):
    """Chains of cells: their numbers, chain after chain. ends: (k + 1,) first of each; degree: (n,) neighbours.

    A chain begins at its lower end; an isolated ring begins and ends at its lowest cell.
    """

    cells: Ints
    ends: Ints
    degree: Ints


def chains(places: Ints) -> Chains:
    """Trace the chains of sorted cells (n, 2) [row, column]."""
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
    """Neighbours (n, 8) of sorted cells (n, 2) [row, column], -1 for none; and their count (n,)."""
    count = len(places)
    keys = (places[:, 0] << _ROW_BITS) + places[:, 1]
    links = np.full((count, 8), -1, np.int64)
    for k in range(8):
        dy, dx = _STEPS[k, 0], _STEPS[k, 1]
        offset, at = (dy << _ROW_BITS) + dx, 0
        for i in range(count):  # sought grows with i, so one pass is enough
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
    """Returns the number of cells, even beyond capacity, and of chains."""
    seen = degree != 2
    used, count = _trace_between(links, degree, seen, cells, ends)
    return _trace_rings(links, degree, seen, cells, ends, used, count)


@numba.njit(cache=True, nogil=True)
def _trace_between(links: Any, degree: Any, seen: Any, cells: Any, ends: Any) -> tuple[int, int]:
    """Chains between ends and junctions; marks cells as seen."""
    used, count = ZERO, 0
    for place in range(8 * len(links)):
        start, second = place // 8, links[place // 8, place % 8]
        if degree[start] == 2 or second < 0:
            continue
        first, used = used, _follow(links, degree, start, second, cells, used)
        if used > len(cells):
            continue
        last, before = cells[used - 1], cells[used - 2]
        if last < start or (last == start and before < second):
            used = first  # traced from its other end
            continue
        for i in range(first, used):
            seen[cells[i]] = True
        count += 1
        ends[count] = used
    return used, count


@numba.njit(cache=True, nogil=True)
def _trace_rings(links: Any, degree: Any, seen: Any, cells: Any, ends: Any, used: int, count: int) -> tuple[int, int]:
    """Isolated rings, from the lowest cell to its first neighbour."""
    for start in range(len(links)):
        if seen[start]:
            continue
        second = ZERO - 1
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
    """A chain up to the next end or junction, or back to `start`."""
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
