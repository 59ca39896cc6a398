"""Segments: roads cut at a fixed lattice and named by place, so that names last as long as roads.

A name is the lattice cell of the middle and the axis there, numbered by fifths of the cell if several share both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapserver.roads.cutting import LATTICE_M, cut, gathered
from mapserver.roads.network import Network
from protocol.arrays import AnyArray, Floats, Ints

AXES = ("e", "n")  # names of axes; more would rename more roads, near a border of two
FIFTHS = 5


@dataclass(frozen=True)
class SegmentTable:
    """All segments, sorted by cell and axis.

    ids: (k,). points: (n, 2) x, y [m]; ends: (k + 1,) first point of each. ahead: (k, 2) unit vector along the axis.
    length_m: (k,). nodes: (k, 2) of the graph, -1 where the road continues.
    """

    ids: tuple[str, ...]
    points: Floats
    ends: Ints
    ahead: Floats
    length_m: Floats
    nodes: Ints

    def line(self, index: int) -> Floats:
        """The line (m, 2) of a segment."""
        return self.points[self.ends[index] : self.ends[index + 1]]


def segments(graph: Network) -> SegmentTable:
    """Cut, orient and name all edges."""
    points, pieces = cut(graph.points, graph.ends, graph.nodes)
    first, last, nodes = pieces[:, 0], pieces[:, 1], pieces[:, 2:]
    run, half = points[last] - points[first], (last - first + 1) // 2
    small = ~run.any(axis=1)  # small rings: from beginning to middle
    run[small] = points[first + half][small] - points[first][small]
    axis = np.rint(np.arctan2(run[:, 1], run[:, 0]) * len(AXES) / np.pi).astype(np.int64) % (2 * len(AXES))
    back = axis >= len(AXES)
    middle = points[np.where(back, last - half, first + half)]
    run[back] *= -1
    axis[back] -= len(AXES)
    cell = np.floor(middle / LATTICE_M).astype(np.int64)
    turn = np.pi * axis / len(AXES)
    place = middle - (cell + 0.5) * LATTICE_M
    beside = place[:, 1] * np.cos(turn) - place[:, 0] * np.sin(turn)  # to the left of the cell's middle [m]
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
    """Sorted. The segment nearest to a cell's middle has the plain name."""
    names = [f"{column}_{row}_{AXES[own]}" for (column, row), own in zip(cell.tolist(), axis.tolist(), strict=True)]
    key = np.concatenate([cell, axis[:, None]], axis=1)
    bounds = [*np.flatnonzero((np.diff(key, axis=0, prepend=key[:1] - 1) != 0).any(axis=1)).tolist(), len(names)]
    for first, end in pairwise(bounds):
        if end - first > 1:
            names[first:end] = _distinct(names[first], beside[first:end])
    return tuple(names)


def _distinct(name: str, beside: AnyArray) -> list[str]:
    nearest, used, names = int(np.argmin(np.abs(beside))), {name}, []
    for i, off in enumerate(beside.tolist()):
        other = f"{name}.{int(np.floor(off * FIFTHS / LATTICE_M + FIFTHS / 2))}"
        while other in used:  # two in one fifth, in a knot; such names may change
            other += "'"
        names.append(name if i == nearest else other)
        used.add(names[-1])
    return names
