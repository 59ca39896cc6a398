"""The graph of roads: what is no road goes (spurs, bridges that nobody drove along, overlong ends), junctions join.

All rules look at places and metres alone, never at what was there before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import WEIGHT_UNITS_PER_M
from mapserver.roads.chains import Chains, chains
from mapserver.roads.ridges import AXES
from mapserver.roads.skeleton import Skeleton
from protocol.arrays import AnyArray, Floats, Ints

SPUR_M = 10.0  # shorter dead ends at a junction are the width of a road, not a road
LEAST_ROAD_M = 15.0  # a road by itself is no shorter than a machine and its position error
JOIN_M = 6.0  # junctions nearer to each other are one: two lines that cross share a few cells
ROUNDS = 8  # of pruning: what it leaves after that is drawn as it is
# A cell of a line was driven along where the 5 x 5 cells around it have so many metres along it: a fifth of one pass.
DRIVEN_M = 1.0
DRIVEN_SHARE = 0.7  # of an edge's cells, for the edge to be one
# A road ends where there is so much of what was driven so many cells farther in: half of the 5 x 5 cells is beyond.
END_SHARE, INWARD = 0.45, 8
TANGENT = 4  # cells to each side that the direction of a line is taken from


@dataclass(frozen=True)
class Network:
    """Edges as lines. points: (n, 2) x, y [m] of all edges; ends: (k + 1,) where each begins; nodes: (k, 2) numbers.

    The nodes of an edge are what its two ends join; a ring by itself has the same one twice.
    """

    points: Floats
    ends: Ints
    nodes: Ints


def network(skeleton: Skeleton) -> Network:
    """The graph of roads of a skeleton."""
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
    """Which cells (n,) are no road; cells, ends, degree: as in Chains."""
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
        # Ends that nobody drove: the blur makes lines longer than they are.
        if loose_first:
            _trim(along, cells, first, last, 1, gone)
        if loose_last:
            _trim(along, cells, first, last, -1, gone)
    return gone


@numba.njit(cache=True, nogil=True)
def _step(one: AnyArray, other: AnyArray) -> float:
    """Cells from one to the next one of a chain."""
    return 1.4142135623730951 if abs(one[0] - other[0]) + abs(one[1] - other[1]) == 2 else 1.0


@numba.njit(cache=True, nogil=True)
def _trim(along: AnyArray, cells: AnyArray, first: int, last: int, step: int, gone: AnyArray) -> None:
    """Take cells off a dead end of a chain, until there is about half of what is driven farther in."""
    at = first if step > 0 else last
    while first <= at + INWARD * step <= last and along[at] < END_SHARE * along[at + INWARD * step]:
        gone[cells[at]] = True
        at += step


@numba.njit(cache=True, nogil=True)
def _along(places: AnyArray, metres: AnyArray, cells: AnyArray, first: int, last: int, at: int) -> int:
    """Metres driven along a chain around one of its cells, in 1/4096 m."""
    before, after = places[cells[max(at - TANGENT, first)]], places[cells[min(at + TANGENT, last)]]
    turn = np.arctan2(float(after[0] - before[0]), float(after[1] - before[1]))
    axis = int(np.rint(turn * AXES / np.pi))
    own = metres[cells[at]]
    return int(own[(axis - 1) % AXES] + own[axis % AXES] + own[(axis + 1) % AXES])


def _lengths(places: Ints, cells: Ints, ends: Ints, raster_m: float) -> Floats:
    """Length of each chain [m]."""
    steps = np.abs(np.diff(places[cells], axis=0, prepend=places[cells[:1]]))
    step = np.where(steps.sum(axis=1) == 2, np.sqrt(2.0), 1.0)
    step[ends[:-1]] = 0.0
    return np.asarray(np.add.reduceat(step, ends[:-1]) * raster_m, np.float64)


def _lines(places: Ints, traced: Chains, raster_m: float) -> Network:
    """Chains as lines, with junctions that are near to each other joined."""
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
    """Lowest number of those that are joined by pairs, for each number."""
    group = np.arange(count)
    for i in range(len(one)):
        a, b = one[i], other[i]
        while group[a] != a:
            a = group[a]
        while group[b] != b:
            b = group[b]
        group[max(a, b)] = min(a, b)
    for i in range(count):  # lower ones first, so that each takes one step
        group[i] = group[group[i]]
    return group
