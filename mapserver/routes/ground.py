"""Layers of cells as a route reads them: between their centres, over those of the four around that are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from protocol.arrays import AnyArray, Floats, Ints

LEAST_SHARE = 0.25  # of the weights of four cells: less is a cell's corner, and no ground under a wheel
HALF = 2**20


@dataclass(frozen=True)
class Squares:
    """Layers of square parts of the map, edge cells to a side.

    places (k, 2): column and row of each square; layers: name -> (k, edge, edge), NaN where unknown.
    """

    cell_m: float
    edge: int
    places: Ints
    layers: Mapping[str, AnyArray]

    @classmethod
    def stacked(cls, cell_m: float, edge: int, squares: Mapping[tuple[int, int], Mapping[str, AnyArray]]) -> Squares:
        """Of layers (edge, edge) by the place of their square; at least one of them."""
        places = sorted(squares)
        names = squares[places[0]].keys()
        layers = {name: np.stack([squares[place][name] for place in places]) for name in names}
        return cls(cell_m, edge, np.array(places), layers)

    def at(self, position_m: Floats, names: Sequence[str] = ()) -> dict[str, Floats]:
        """Layers (n,) at places (n, 2), all or some: bilinear over the known of the four cells around; NaN of none."""
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
        """Index of each square by its column and row."""
        return {(x, y): i for i, (x, y) in enumerate(self.places.tolist())}

    def _find(self, x: Ints, y: Ints) -> Ints:
        """Index (n,) of the squares at these places, -1 where there is none."""
        keys, wanted = _key(*self.places.T), _key(x, y)
        order = np.argsort(keys)
        at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
        return np.where(keys[order[at]] == wanted, order[at], -1)


@numba.njit(cache=True, nogil=True)
def _add_known(layer: Any, at: Any, y: Any, x: Any, share: Any, sums: Any) -> None:
    """Add shares (n,) of the known of these cells of squares, and of their values, to sums (2, n): values, shares."""
    for i in range(len(at)):
        if at[i] >= 0:
            value = np.float64(layer[at[i], y[i], x[i]])
            if np.isfinite(value):
                sums[0, i] += share[i] * value
                sums[1, i] += share[i]


def squares_at(position_m: Floats, cell_m: float, edge: int) -> set[tuple[int, int]]:
    """Columns and rows of the squares, edge cells to a side, that the four cells around places (n, 2) lie in."""
    first = np.floor(position_m / cell_m - 0.5).astype(np.int64)
    corners = [(first + np.array([x, y])) // edge for x in (0, 1) for y in (0, 1)]
    keys = np.unique(np.concatenate([_key(*corner.T) for corner in corners]))
    return set(zip((keys // (2 * HALF) - HALF).tolist(), (keys % (2 * HALF) - HALF).tolist(), strict=True))


def _key(x: Ints, y: Ints) -> Ints:
    return (x + HALF) * (2 * HALF) + (y + HALF)
