"""The cheapest line between two cells.

In each cell a line costs its length times a cost per metre that depends on direction. A search with 16 neighbours finds
the passage, up to 2.75 % too long. A second one with 64 neighbours searches a band around it; then straight pieces in
any direction replace more expensive ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product
from typing import Any

import cv2
import numba
import numpy as np

from mapserver.routes.grid_search import LEAST_COST, dijkstra
from protocol.arrays import Bools, Floats, Ints

Cell = tuple[int, int]  # row and column in a window

LOOK_AHEAD = 64  # places that a straight piece may skip; the next pass skips as many again
BAND = 16  # half width in cells; with 8 one map in a hundred has its cheapest line outside (by 2 %), with 24 none more


@dataclass(frozen=True)
class CostField:
    """What lines cost over a window of cells.

    resistance, grade_east, grade_north (rows, columns): finite where is_open; resistance positive. crawl: resistance
    plus slope at which power limits the speed, for costs in time; inf for costs in energy.
    """

    resistance: Floats
    grade_east: Floats
    grade_north: Floats
    is_open: Bools
    cell_m: float
    crawl: float = math.inf


def least_cost_line(terrain: CostField, start: Cell, end: Cell) -> tuple[Ints, float] | None:
    """Corners (n, 2) [row, column] of the cheapest line, and its cost; None if there is no line.

    Unit: metres of lift, or metres at top speed if crawl is finite.
    """
    line = _search(terrain, start, end, moves(2))
    if line is None:
        return None
    around = replace(terrain, is_open=terrain.is_open & _band(terrain.is_open.shape, line))
    finer = _search(around, start, end, moves(4))
    return straightened(terrain, line if finer is None else finer)


def _search(terrain: CostField, start: Cell, end: Cell, steps: Ints) -> Ints | None:
    """Cells (n, 2) of the cheapest line in steps (k, 2)."""
    border = int(np.abs(steps).max())
    columns = terrain.is_open.shape[1] + 2 * border
    ground, (cells, shares) = _bordered(terrain, border), _touched(steps)
    source, target = ((row + border) * columns + column + border for row, column in (start, end))
    distance, before = np.full(len(ground), math.inf), np.full(len(ground), -1, np.int32)
    onward = cells @ np.array([columns, 1])
    dijkstra(ground, columns, terrain.cell_m, terrain.crawl, steps, onward, shares, source, target, distance, before)
    if not math.isfinite(distance[target]):
        return None
    places = [target]
    while places[-1] != source:
        places.append(int(before[places[-1]]))
    return np.stack(np.divmod(np.array(places[::-1]), columns), axis=1) - border


def _bordered(terrain: CostField, border: int) -> Floats:
    """Resistance and slopes (n, 3) by rows, with a closed border; inf where closed."""
    rows, columns = terrain.is_open.shape
    out = np.zeros((rows + 2 * border, columns + 2 * border, 3))
    out[..., 0] = math.inf
    inner = out[border : border + rows, border : border + columns]
    inner[..., 0] = np.where(terrain.is_open, terrain.resistance, math.inf)
    inner[..., 1], inner[..., 2] = terrain.grade_east, terrain.grade_north
    return out.reshape(-1, 3)


def _band(shape: tuple[int, int], line: Ints) -> Bools:
    drawn = np.zeros(shape, np.uint8)
    cv2.polylines(drawn, [line[:, ::-1].astype(np.int32).reshape(-1, 1, 2)], isClosed=False, color=1)
    band: Bools = cv2.dilate(drawn, np.ones((2 * BAND + 1, 2 * BAND + 1), np.uint8)) > 0
    return band


def reaches(terrain: CostField, start: Cell, end: Cell) -> bool:
    """Whether any line connects two cells."""
    # a line passes a corner only if both cells beside it are open
    _, part = cv2.connectedComponents(terrain.is_open.astype(np.uint8), connectivity=4)
    return bool(terrain.is_open[start] and terrain.is_open[end] and part[start] == part[end])


@lru_cache
def moves(order: int) -> Ints:
    """Steps (k, 2) [row, column]: 8 of order 1, 16 of 2, 32 of 3, 64 of 4 (a Farey sequence)."""
    quarter = [(0, 1), (1, 0)]
    for _ in range(order):
        sums = [(a[0] + b[0], a[1] + b[1]) for a, b in pairwise(quarter)]
        quarter = [step for pair in zip(quarter, [*sums, None], strict=True) for step in pair if step]
    turned = [(row, column) for row, column in quarter[:-1]]
    whole = []
    for _ in range(4):
        whole += turned
        turned = [(-column, row) for row, column in turned]
    return np.array(whole)


def cost_of(terrain: CostField, line: Ints) -> float:
    """Cost of a line (n, 2) of cells; inf outside open cells."""
    return float(sum(_piece(*_arrays(terrain), *a, *b) for a, b in pairwise(line)))


def straightened(terrain: CostField, line: Ints) -> tuple[Ints, float]:
    """Drop places of a line (n, 2) where straight pieces cost less; returns line and cost."""
    while True:
        kept = np.zeros(len(line), np.bool_)
        cost = _straighten(*_arrays(terrain), line, kept)
        if kept.all():
            return line, cost
        line = line[kept]


def _arrays(terrain: CostField) -> tuple[Floats, Floats, Floats, Bools, float, float]:
    fields = (
        np.ascontiguousarray(a, np.float64) for a in (terrain.resistance, terrain.grade_east, terrain.grade_north)
    )
    resistance, east, north = fields
    return resistance, east, north, terrain.is_open, terrain.cell_m, terrain.crawl


def _touched(steps: Ints) -> tuple[Ints, Floats]:
    """Cells (k, m, 2) that each step touches, relative, and shares (k, m) of its length; -1 pads."""
    order = int(np.abs(steps).max())
    cells, shares = np.zeros((len(steps), 4 * order, 2), np.int64), np.full((len(steps), 4 * order), -1.0)
    for k, (down, right) in enumerate(steps.tolist()):
        cuts = {0.0, 1.0, *((i + 0.5) / abs(n) for n in (down, right) if n for i in range(abs(n)))}
        ends = sorted(cuts)
        crossed = [((a + b) / 2, b - a) for a, b in pairwise(ends)]
        touched = {(round(down * at), round(right * at)): share for at, share in crossed}
        for at in ends[1:-1]:  # through a corner it touches both cells beside
            y, x = down * at, right * at
            if abs(y % 1 - 0.5) < 1e-9 and abs(x % 1 - 0.5) < 1e-9:
                for cell in product((math.floor(y), math.ceil(y)), (math.floor(x), math.ceil(x))):
                    touched.setdefault(cell, 0.0)
        cells[k, : len(touched)], shares[k, : len(touched)] = list(touched), list(touched.values())
    return cells, shares


@numba.njit(cache=True, nogil=True)
def _straighten(
    resistance: Any, east: Any, north: Any, is_open: Any, cell_m: float, crawl: float, line: Any, kept: Any
) -> float:
    """Mark the places between which straight pieces cost least; returns the cost."""
    n = len(line)
    best, before = np.full(n, math.inf), np.full(n, -1, np.int64)
    best[0] = 0.0
    for j in range(1, n):
        for i in range(max(j - LOOK_AHEAD, 0), j):
            cost = best[i] + _piece(
                resistance, east, north, is_open, cell_m, crawl, line[i, 0], line[i, 1], line[j, 0], line[j, 1]
            )
            if cost < best[j] * (1 - 1e-9):  # of equal costs the one with fewer places
                best[j], before[j] = cost, i
    at = n - 1
    while at >= 0:
        kept[at] = True
        at = before[at]
    return float(best[n - 1])


@numba.njit(cache=True, nogil=True)
def _piece(
    resistance: Any,
    east: Any,
    north: Any,
    is_open: Any,
    cell_m: float,
    crawl: float,
    row: int,
    column: int,
    to_row: int,
    to_column: int,
) -> float:
    """Cost of a straight piece between two cell centres; inf if it touches a closed cell.

    Traversal by Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987. A corner touches both
    cells beside it.
    """
    down, right = to_row - row, to_column - column
    length_m = math.sqrt(down * down + right * right) * cell_m
    if length_m == 0.0:
        return 0.0
    x, y = right * cell_m / length_m, down * cell_m / length_m
    step_row, step_column = (1 if down > 0 else -1), (1 if right > 0 else -1)
    # shares of the length where the next row and column begin
    per_row = 1.0 / abs(down) if down else math.inf
    per_column = 1.0 / abs(right) if right else math.inf
    next_row, next_column = 0.5 * per_row, 0.5 * per_column
    at, total = 0.0, 0.0
    while True:
        if not is_open[row, column]:
            return math.inf
        end = min(next_row, next_column, 1.0)
        climbs = resistance[row, column] + east[row, column] * x + north[row, column] * y
        total += (end - at) * (max(climbs, LEAST_COST) if crawl == math.inf else max(climbs / crawl, 1.0))
        if row == to_row and column == to_column:
            return float(total * length_m)
        at = end
        if abs(next_row - next_column) < 1e-9:
            if not (is_open[row + step_row, column] and is_open[row, column + step_column]):
                return math.inf
            row, column = row + step_row, column + step_column
            next_row, next_column = next_row + per_row, next_column + per_column
        elif next_row < next_column:
            row, next_row = row + step_row, next_row + per_row
        else:
            column, next_column = column + step_column, next_column + per_column
