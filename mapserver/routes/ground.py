"""Ground along a route: layers interpolated between cell centres, and the line in even steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from protocol.arrays import AnyArray, Floats, Ints

LEAST_SHARE = 0.25  # least weight of known cells; less is a cell's corner, not ground under a wheel
HALF = 2**20
CURVE_M = 7.0  # metres over which a corner changes the direction: about a machine's turning circle
REVERSAL_RAD = math.radians(120.0)  # at sharper corners a machine stops and reverses


@dataclass(frozen=True)
class Squares:
    """Layers of square parts of the map.

    places (k, 2): column and row of each; layers: (k, edge, edge), NaN where unknown; edge: in cells.
    """

    cell_m: float
    edge: int
    places: Ints
    layers: Mapping[str, AnyArray]

    @classmethod
    def stacked(cls, cell_m: float, edge: int, squares: Mapping[tuple[int, int], Mapping[str, AnyArray]]) -> Squares:
        """Stack layers (edge, edge) by place of their square; at least one."""
        places = sorted(squares)
        names = squares[places[0]].keys()
        layers = {name: np.stack([squares[place][name] for place in places]) for name in names}
        return cls(cell_m, edge, np.array(places), layers)

    def at(self, position_m: Floats, names: Sequence[str] = ()) -> dict[str, Floats]:
        """Layers (n,) at places (n, 2), bilinear over the known ones of four cells; NaN where none is."""
        column, row = (position_m / self.cell_m - 0.5).T
        out = {name: np.zeros((2, len(position_m))) for name in names or self.layers}
        for right in (0, 1):
            for up in (0, 1):
                x, y = np.floor(column).astype(np.int64) + right, np.floor(row).astype(np.int64) + up
                share = np.maximum(1 - np.abs(column - x), 0) * np.maximum(1 - np.abs(row - y), 0)
                at, inside = self._find(x // self.edge, y // self.edge), (y % self.edge, x % self.edge)
                for name, sums in out.items():
                    _add_known(self.layers[name], at, *inside, share, sums)
        return {
            name: np.where(weight > LEAST_SHARE, total / np.maximum(weight, LEAST_SHARE), np.nan)
            for name, (total, weight) in out.items()
        }

    def by_place(self) -> dict[tuple[int, int], int]:
        """Index by column and row."""
        return {(x, y): i for i, (x, y) in enumerate(self.places.tolist())}

    def _find(self, x: Ints, y: Ints) -> Ints:
        """Indices (n,) of squares, -1 for none."""
        keys, wanted = _key(*self.places.T), _key(x, y)
        order = np.argsort(keys)
        at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
        return np.where(keys[order[at]] == wanted, order[at], -1)


@numba.njit(cache=True, nogil=True)
def _add_known(layer: Any, at: Any, y: Any, x: Any, share: Any, sums: Any) -> None:
    """Add weighted values of known cells, and their weights (n,), to sums (2, n)."""
    for i in range(len(at)):
        if at[i] >= 0:
            value = np.float64(layer[at[i], y[i], x[i]])
            if np.isfinite(value):
                sums[0, i] += share[i] * value
                sums[1, i] += share[i]


def squares_at(position_m: Floats, cell_m: float, edge: int) -> set[tuple[int, int]]:
    """Squares (column, row) of the four cells around each of places (n, 2)."""
    first = np.floor(position_m / cell_m - 0.5).astype(np.int64)
    corners = [(first + np.array([x, y])) // edge for x in (0, 1) for y in (0, 1)]
    keys = np.unique(np.concatenate([_key(*corner.T) for corner in corners]))
    return set(zip((keys // (2 * HALF) - HALF).tolist(), (keys % (2 * HALF) - HALF).tolist(), strict=True))


def _key(x: Ints, y: Ints) -> Ints:
    return (x + HALF) * (2 * HALF) + (y + HALF)


@dataclass(frozen=True)
class Steps:
    """n even steps along a line.

    length_m (n,); position_m, direction (n, 2): middles and unit vectors, in `map`; end_m (n + 1,): distance from the
    start.
    """

    length_m: Floats
    position_m: Floats
    direction: Floats
    end_m: Floats


def lengths(line_m: Floats) -> Floats:
    """Lengths (n - 1,) of the pieces of a line (n, 2)."""
    return np.asarray(np.hypot(*np.diff(line_m, axis=0).T))


def steps(line_m: Floats, step_m: float) -> Steps:
    """Cut a line (k, 2) of at least two places into equal steps of about step_m."""
    distance_m = np.concatenate([[0.0], np.cumsum(lengths(line_m))])
    n = max(1, round(distance_m[-1] / step_m))
    end_m = np.linspace(0.0, distance_m[-1], n + 1)
    ends = np.stack([np.interp(end_m, distance_m, axis) for axis in line_m.T], axis=1)
    middle_m = 0.5 * (end_m[:-1] + end_m[1:])
    position = np.stack([np.interp(middle_m, distance_m, axis) for axis in line_m.T], axis=1)
    along = np.diff(ends, axis=0)
    chord = np.hypot(*along.T)
    piece = np.clip(np.searchsorted(distance_m, middle_m, side="right") - 1, 0, len(line_m) - 2)
    own = np.diff(line_m, axis=0)[piece] / np.maximum(lengths(line_m)[piece], 1e-12)[:, None]
    # a step that turns back has no useful chord: its piece gives the direction
    direction = np.where((chord > 0.5 * np.diff(end_m))[:, None], along / np.maximum(chord, 1e-12)[:, None], own)
    return Steps(np.diff(end_m), position, direction, end_m)


def limits(line_m: Floats, end_m: Floats, lateral_mps2: float) -> Floats:
    """Speed limits (n + 1,) at the ends of steps [m/s]: inf where straight, 0 where the line reverses.

    Curvature k keeps k v^2 below lateral_mps2; it is the change of direction within CURVE_M, divided by CURVE_M.
    """
    distance_m = np.concatenate([[0.0], np.cumsum(lengths(line_m))])
    pieces = np.diff(line_m, axis=0)
    turn = np.diff(np.arctan2(pieces[:, 1], pieces[:, 0]))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi  # (k - 2,), inner corners
    corner_m, reverses = distance_m[1:-1], np.abs(turn) > REVERSAL_RAD
    turned = np.concatenate([[0.0], np.cumsum(np.where(reverses, 0.0, turn))])
    first, last = (np.searchsorted(corner_m, end_m + side * CURVE_M / 2, side="right") for side in (-1, 1))
    curvature = np.abs(turned[last] - turned[first]) / CURVE_M
    limit = np.sqrt(lateral_mps2 / np.maximum(curvature, 1e-12))
    limit[curvature < 1e-9] = np.inf
    limit[np.unique(np.abs(end_m[:, None] - corner_m[reverses]).argmin(axis=0))] = 0.0
    return np.asarray(limit)
