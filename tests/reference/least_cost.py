"""Cheapest line in steps to 64 neighbours over all cells, by scipy with numpy costs.

Shares only the definition of cost with the tested code: length in each cell times its cost per metre.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from mapserver.routes.grid_search import LEAST_COST
from mapserver.routes.least_cost import Cell, CostField
from protocol.arrays import Floats, Ints

POINTS = 480  # subdivisions of a step


def neighbours(order: int) -> Ints:
    """Steps (k, 2) in rows and columns: 8 for order 1, 16 for 2, 32 for 3, 64 for 4, in distinct directions."""
    near: set[tuple[int, int]] = set()
    quarter = [(0, 1), (1, 0)]
    for _ in range(order):
        between = [(a[0] + b[0], a[1] + b[1]) for a, b in pairwise(quarter)]
        quarter = sorted({*quarter, *between}, key=lambda step: math.atan2(*step))
    for row, column in quarter:
        near |= {(row * up, column * right) for up in (-1, 1) for right in (-1, 1)}
    return np.array(sorted(near))


def graph(terrain: CostField, steps: Ints) -> csr_matrix:
    """Costs of all steps (k, 2) from all cells of open ground."""
    rows, columns = terrain.resistance.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    starts, ends, costs = [], [], []
    for down, right in steps.tolist():
        reach = max(abs(down), abs(right))
        norm = math.hypot(down, right)
        per_m = terrain.resistance + (terrain.grade_east * right + terrain.grade_north * down) / norm
        per_m = np.pad(np.maximum(per_m, LEAST_COST), reach, constant_values=np.inf)
        total = np.zeros((rows, columns))
        for (row, column), share in _crossed(down, right).items():
            total += share * per_m[reach + row : reach + row + rows, reach + column : reach + column + columns]
        here = np.isfinite(total)
        starts.append(index[here])
        ends.append(index[here] + down * columns + right)
        costs.append(total[here] * norm * terrain.cell_m)
    edges = np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))
    return csr_matrix(edges, shape=(rows * columns, rows * columns))


def least_cost(terrain: CostField, start: Cell, end: Cell, order: int = 4) -> float:
    """Cost of the cheapest line between cells."""
    columns = terrain.resistance.shape[1]
    distance: Floats = dijkstra(graph(terrain, neighbours(order)), indices=start[0] * columns + start[1])
    return float(distance[end[0] * columns + end[1]])


def _crossed(down: int, right: int) -> dict[tuple[int, int], float]:
    """Crossed cells of a step, with their shares of its length."""
    at = (np.arange(POINTS) + 0.5) / POINTS
    cells = np.floor(np.stack([down * at, right * at], axis=1) + 0.5).astype(int)
    unique, counts = np.unique(cells, axis=0, return_counts=True)
    return {(row, column): count / POINTS for (row, column), count in zip(unique.tolist(), counts, strict=True)}
