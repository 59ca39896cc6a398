"""Segments: roads cut at a fixed lattice, with names that are places, so that they last as long as the road does.

The name of a segment is the lattice cell in which its middle lies and the axis along which it runs there. Two of one
cell and axis are told apart by the fifth of the cell in which they lie across.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapserver.roads.network import Network
from protocol.arrays import Floats, Ints

LATTICE_M = 25.0
SLIVER_M = 9.0  # shorter pieces join a neighbour
LEAST_M = 3.0  # an edge that is shorter is no segment
SMOOTH = 4  # points to each side that a point of a line is the mean of: cells are a metre wide
AXES = ("e", "ne", "n", "nw")
FIFTHS = 5


@dataclass(frozen=True)
class Segments:
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


def segments(graph: Network) -> Segments:
    """Cut a graph of roads."""
    lines, nodes = [], []
    for k in range(len(graph.ends) - 1):
        line = _smooth(graph.points[graph.ends[k] : graph.ends[k + 1]])
        if _length(line) < LEAST_M:
            continue
        closed = bool((line[0] == line[-1]).all())
        parts = _cut(line, closed=closed)
        lines += parts
        ends = np.full((len(parts), 2), -1)
        if len(parts) and not (closed and graph.nodes[k, 0] == graph.nodes[k, 1]):
            ends[0, 0], ends[-1, 1] = graph.nodes[k]
        nodes.append(ends)
    return _named(lines, np.concatenate([np.zeros((0, 2), np.int64), *nodes]))


def _smooth(line: Floats) -> Floats:
    """Moving average of a line; its ends stay, and a ring has none."""
    if len(line) < 3:
        return line
    k = min(SMOOTH, len(line) - 2)
    if (line[0] == line[-1]).all():
        padded = np.concatenate([line[-1 - k : -1], line, line[1 : 1 + k]])
    else:
        padded = np.concatenate([2 * line[0] - line[k:0:-1], line, 2 * line[-1] - line[-2 : -2 - k : -1]])
    return np.asarray(sum(padded[i : i + len(line)] for i in range(2 * k + 1)) / (2 * k + 1), np.float64)


def _cut(line: Floats, *, closed: bool) -> list[Floats]:
    """Cut a line where it enters another cell of the lattice; the parts share their ends."""
    cell = np.floor(line / LATTICE_M).astype(np.int64)
    breaks = np.flatnonzero((np.diff(cell, axis=0) != 0).any(axis=1)) + 1
    if closed and len(breaks):  # a ring begins at a cut
        start = int(breaks[0])
        line = np.concatenate([line[start:-1], line[: start + 1]])
        breaks = breaks[1:] - start
    bounds = np.concatenate([[0], breaks, [len(line) - 1]])
    bounds = bounds[np.concatenate([[True], np.diff(bounds) > 0])]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    while (shortest := _sliver(bounds, along)) >= 0:
        before = along[bounds[shortest]] - along[bounds[shortest - 1]] if shortest else np.inf
        after = np.inf
        if shortest + 2 < len(bounds):
            after = along[bounds[shortest + 2]] - along[bounds[shortest + 1]]
        bounds = np.delete(bounds, shortest if before <= after else shortest + 1)
    return [line[first : last + 1] for first, last in pairwise(bounds.tolist())]


def _sliver(bounds: Ints, along: Floats) -> int:
    """The shortest of several pieces, where that is a sliver; else -1."""
    if len(bounds) < 3:
        return -1
    lengths = np.diff(along[bounds])
    at = int(np.argmin(lengths))
    return at if lengths[at] < SLIVER_M else -1


def _length(line: Floats) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def _named(lines: list[Floats], nodes: Ints) -> Segments:
    """Turn all lines into the directions of their axes, and name them."""
    columns = []
    for i, line in enumerate(lines):
        run = line[-1] - line[0]
        middle = line[len(line) // 2]
        if not run.any():  # a small ring: from its beginning to its middle
            run = middle - line[0]
        octant = int(np.rint(np.arctan2(run[1], run[0]) * 4 / np.pi)) % 8
        if octant >= len(AXES):
            lines[i], nodes[i], run, octant = line[::-1], nodes[i, ::-1].copy(), -run, octant - len(AXES)
        column, row = np.floor(middle / LATTICE_M).astype(np.int64).tolist()
        turn = np.pi * octant / 4
        place = middle - (np.array([column, row]) + 0.5) * LATTICE_M
        beside = float(place[1] * np.cos(turn) - place[0] * np.sin(turn))  # to the left of the cell's middle
        columns.append((column, row, octant, beside, *middle.tolist(), *(run / np.hypot(*run)).tolist(), i))
    columns.sort()
    order = [int(entry[-1]) for entry in columns]
    points = [lines[i] for i in order]
    return Segments(
        _ids(columns),
        np.concatenate([np.zeros((0, 2)), *points]),
        np.cumsum([0, *map(len, points)]),
        np.array([entry[6:8] for entry in columns]).reshape(-1, 2),
        np.array([_length(line) for line in points]),
        nodes[order].reshape(-1, 2),
    )


def _ids(columns: list[tuple[float, ...]]) -> tuple[str, ...]:
    """Names of segments, sorted. Of several in one cell and axis, the one nearest to its middle has the plain name."""
    groups: dict[str, list[tuple[float, int]]] = {}
    for i, (column, row, octant, beside, *_) in enumerate(columns):
        groups.setdefault(f"{column:.0f}_{row:.0f}_{AXES[int(octant)]}", []).append((beside, i))
    names: dict[int, str] = {}
    for name, own in groups.items():
        nearest = min(own, key=lambda each: (abs(each[0]), each))
        used = {name}
        for beside, i in own:
            fifth = int(np.floor(beside * FIFTHS / LATTICE_M + FIFTHS / 2))
            other = f"{name}.{fifth}"
            while other in used:  # two in one fifth: a knot, whose parts have no name of their own that lasts
                other += "'"
            names[i] = name if (beside, i) == nearest else other
            used.add(names[i])
    return tuple(names[i] for i in range(len(columns)))
