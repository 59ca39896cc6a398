"""Segments: roads cut at a fixed lattice, with names that are places, so that they last as long as the road does.

The name of a segment is the lattice cell in which its middle lies and the axis along which it runs there. Two of one
cell and axis are told apart by the fifth of the cell in which they lie across.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapserver.roads.cutting import LATTICE_M, cut, gathered
from mapserver.roads.network import Network
from protocol.arrays import AnyArray, Floats, Ints

AXES = ("e", "n")  # a third or fourth one would rename more roads, as one is always near the border of two
FIFTHS = 5


@dataclass(frozen=True)
class SegmentTable:
    """All segments of a map, in the order of their names' places.

    ids: (k,) names. points: (n, 2) x, y [m] of all lines, each from its beginning to its end; ends: (k + 1,) where
    each begins. ahead: (k, 2) unit vector from beginning to end, which points to the axis of the name. length_m: (k,).
    nodes: (k, 2) the graph's nodes that it touches at either end, -1 where it goes on in the next segment.
    """

    ids: tuple[str, ...]
    points: Floats
    ends: Ints
    ahead: Floats
    length_m: Floats
    nodes: Ints

    def line(self, index: int) -> Floats:
        """The line (m, 2) of one segment."""
        return self.points[self.ends[index] : self.ends[index + 1]]


def segments(graph: Network) -> SegmentTable:
    """Cut a graph of roads, turn all pieces into the directions of their axes, and name them."""
    points, pieces = cut(graph.points, graph.ends, graph.nodes)
    first, last, nodes = pieces[:, 0], pieces[:, 1], pieces[:, 2:]
    run, half = points[last] - points[first], (last - first + 1) // 2
    small = ~run.any(axis=1)  # a small ring: from its beginning to its middle
    run[small] = points[first + half][small] - points[first][small]
    axis = np.rint(np.arctan2(run[:, 1], run[:, 0]) * len(AXES) / np.pi).astype(np.int64) % (2 * len(AXES))
    back = axis >= len(AXES)
    middle = points[np.where(back, last - half, first + half)]
    run[back] *= -1
    axis[back] -= len(AXES)
    cell = np.floor(middle / LATTICE_M).astype(np.int64)
    turn = np.pi * axis / len(AXES)
    place = middle - (cell + 0.5) * LATTICE_M
    beside = place[:, 1] * np.cos(turn) - place[:, 0] * np.sin(turn)  # to the left of the cell's middle
    order = np.lexsort((*run.T, *middle.T[::-1], beside, axis, cell[:, 1], cell[:, 0]))
    lines, ends, length_m = gathered(points, first[order], last[order], back[order])
    return SegmentTable(
        _ids(cell[order], axis[order], beside[order]),
        lines,
        ends,
        (run / np.hypot(*run.T)[:, None])[order],
        length_m,
        np.where(back[:, None], nodes[:, ::-1], nodes)[order],
    )


def _ids(cell: Ints, axis: Ints, beside: Floats) -> tuple[str, ...]:
    """Names of segments, sorted. Of several in one cell and axis, the one nearest to its middle has the plain name."""
    names = [f"{column}_{row}_{AXES[own]}" for (column, row), own in zip(cell.tolist(), axis.tolist(), strict=True)]
    key = np.concatenate([cell, axis[:, None]], axis=1)
    bounds = [*np.flatnonzero((np.diff(key, axis=0, prepend=key[:1] - 1) != 0).any(axis=1)).tolist(), len(names)]
    for first, end in pairwise(bounds):
        if end - first > 1:
            names[first:end] = _distinct(names[first], beside[first:end])
    return tuple(names)


def _distinct(name: str, beside: AnyArray) -> list[str]:
    """Names of several segments of one cell and axis, which lie so far to the left of its middle."""
    nearest, used, names = int(np.argmin(np.abs(beside))), {name}, []
    for i, off in enumerate(beside.tolist()):
        other = f"{name}.{int(np.floor(off * FIFTHS / LATTICE_M + FIFTHS / 2))}"
        while other in used:  # two in one fifth: a knot, whose parts have no name of their own that lasts
            other += "'"
        names.append(name if i == nearest else other)
        used.add(names[-1])
    return names
