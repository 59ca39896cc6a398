"""Layers of cells as a route reads them: between their centres, over those of the four around that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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

    def at(self, position_m: Floats) -> dict[str, Floats]:
        """Layers (n,) at places (n, 2): bilinear over the known of the four cells around; NaN where none is."""
        column, row = (position_m / self.cell_m - 0.5).T
        out = {name: (np.zeros(len(position_m)), np.zeros(len(position_m))) for name in self.layers}
        for right in (0, 1):
            for up in (0, 1):
                x, y = np.floor(column).astype(int) + right, np.floor(row).astype(int) + up
                share = np.maximum(1 - np.abs(column - x), 0) * np.maximum(1 - np.abs(row - y), 0)
                at, inside = self._find(x // self.edge, y // self.edge)
                for name, (total, weight) in out.items():
                    value = self.layers[name][at, y % self.edge, x % self.edge].astype(float)
                    known = inside & np.isfinite(value)
                    total += np.where(known, share * np.where(known, value, 0.0), 0.0)
                    weight += np.where(known, share, 0.0)
        return {
            name: np.where(weight > LEAST_SHARE, total / np.maximum(weight, LEAST_SHARE), np.nan)
            for name, (total, weight) in out.items()
        }

    def by_place(self) -> dict[tuple[int, int], int]:
        """Index of each square by its column and row."""
        return {(x, y): i for i, (x, y) in enumerate(self.places.tolist())}

    def _find(self, x: Ints, y: Ints) -> tuple[Ints, AnyArray]:
        """Index (n,) of the squares at these places, and whether they are there."""
        keys, wanted = _key(*self.places.T), _key(x, y)
        order = np.argsort(keys)
        at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
        return order[at], keys[order[at]] == wanted


def squares_at(position_m: Floats, cell_m: float, edge: int) -> set[tuple[int, int]]:
    """Columns and rows of the squares, edge cells to a side, that the four cells around places (n, 2) lie in."""
    first = np.floor(position_m / cell_m - 0.5).astype(int)
    corners = [first + np.array([x, y]) for x in (0, 1) for y in (0, 1)]
    return set(map(tuple, np.unique(np.concatenate(corners) // edge, axis=0).tolist()))


def _key(x: Ints, y: Ints) -> Ints:
    return (x + HALF) * (2 * HALF) + (y + HALF)
