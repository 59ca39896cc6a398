"""The graph of roads: what is no road goes (spurs, bridges that nobody drove along, overlong ends), junctions join.

All rules look at places and metres alone, never at what was there before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from mapserver.evidence.cells import WEIGHT_UNITS_PER_M
from mapserver.roads.chains import Chains, chains
from mapserver.roads.ridges import AXES
from mapserver.roads.skeleton import Skeleton
from protocol.arrays import AnyArray, Bools, Floats, Ints

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
        gone = _superfluous(places, metres, traced, skeleton.raster_m)
        if not gone.any():
            break
        places, metres = places[~gone], metres[~gone]
        traced = chains(places)
    return _lines(places, traced, skeleton.raster_m)


def _superfluous(places: Ints, metres: Ints, traced: Chains, raster_m: float) -> Bools:
    """Which cells are no road."""
    cells, ends, degree = traced
    gone: Bools = degree == 0
    if not len(cells):
        return gone
    length_m = _lengths(places, cells, ends, raster_m)
    along = _along(places, metres, cells, ends)
    driven = along >= DRIVEN_M * WEIGHT_UNITS_PER_M
    first, last = cells[ends[:-1]], cells[ends[1:] - 1]
    free = (degree[first] == 1).astype(np.int64) + (degree[last] == 1)
    share = np.add.reduceat(driven, ends[:-1]) / np.diff(ends)
    out = (free == 1) & (length_m < SPUR_M) | (free == 2) & (length_m < LEAST_ROAD_M)
    out |= (first == last) & (length_m < LEAST_ROAD_M) | (share < DRIVEN_SHARE) & (length_m > JOIN_M)
    of_cell = np.repeat(out, np.diff(ends))
    gone[cells[of_cell & (degree[cells] <= 2)]] = True
    # Ends that nobody drove: the blur makes lines longer than they are.
    for at, begins in ((ends[:-1], True), (ends[1:] - 1, False)):
        loose = np.flatnonzero(degree[cells[at]] == 1)
        _trim(along, cells, ends, loose, begins, gone)
    return gone


@numba.njit(cache=True, nogil=True)
def _trim(along: AnyArray, cells: AnyArray, ends: AnyArray, loose: AnyArray, begins: bool, gone: AnyArray) -> None:  # noqa: FBT001
    """Take cells off the dead ends of some chains, until there is about half of what is driven farther in."""
    for chain in loose:
        step = 1 if begins else -1
        at = ends[chain] if begins else ends[chain + 1] - 1
        while ends[chain] <= at + INWARD * step < ends[chain + 1] and along[at] < END_SHARE * along[at + INWARD * step]:
            gone[cells[at]] = True
            at += step


def _lengths(places: Ints, cells: Ints, ends: Ints, raster_m: float) -> Floats:
    """Length of each chain [m]."""
    steps = np.abs(np.diff(places[cells], axis=0, prepend=places[cells[:1]]))
    step = np.where(steps.sum(axis=1) == 2, np.sqrt(2.0), 1.0)
    step[ends[:-1]] = 0.0
    return np.asarray(np.add.reduceat(step, ends[:-1]) * raster_m, np.float64)


def _along(places: Ints, metres: Ints, cells: Ints, ends: Ints) -> Ints:
    """Metres driven along the chains around each of their cells, in 1/4096 m."""
    number = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    at = np.arange(len(cells))
    before = np.maximum(at - TANGENT, ends[:-1][number])
    after = np.minimum(at + TANGENT, ends[1:][number] - 1)
    rise, run = (places[cells[after]] - places[cells[before]]).T.astype(np.float64)
    axis = np.rint(np.arctan2(rise, run) * AXES / np.pi).astype(np.int64) % AXES
    own = metres[cells]
    return np.asarray(sum(own[at, (axis + turn) % AXES] for turn in (-1, 0, 1)), np.int64)


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
