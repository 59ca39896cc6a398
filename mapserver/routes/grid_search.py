"""Dijkstra's algorithm over the cells of a window: kernels alone, which hold no lock of Python.

Edges are costed as they are needed: a graph of a square kilometre in memory would take 300 MB.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

# Negative costs would give silently wrong distances: downhill a metre costs this, not less. As resistance.
LEAST_COST = 0.002


@numba.njit(cache=True, nogil=True)
def dijkstra(
    resistance: Any,
    east: Any,
    north: Any,
    is_open: Any,
    cell_m: float,
    crawl: float,
    steps: Any,
    cells: Any,
    shares: Any,
    source: int,
    target: int,
    distance: Any,
    before: Any,
) -> None:
    """Cost of the cheapest line from one cell to others, and the cell before each on it, until the target is reached.

    Cells are numbered row by row. The arrays are as of `least_cost.Terrain`; cells, shares: what steps (k, 2) touch.
    distance (n,): inf, before (n,): -1, where no line leads or none was looked for.
    """
    rows, columns = is_open.shape
    norms = np.sqrt((steps * steps).sum(axis=1).astype(np.float64))
    heap, place = np.empty(rows * columns, np.int32), np.full(rows * columns, -1, np.int32)  # -2: settled
    distance[source], heap[0], place[source], size = 0.0, source, 0, 1
    while size > 0:
        node = heap[0]
        if node == target:
            return
        size -= 1
        place[node] = -2
        if size > 0:
            _sift_down(heap, place, distance, heap[size], size)
        row, column = node // columns, node % columns
        for k in range(len(steps)):
            to_row, to_column = row + steps[k, 0], column + steps[k, 1]
            if not (0 <= to_row < rows and 0 <= to_column < columns):
                continue
            to = to_row * columns + to_column
            if place[to] == -2:
                continue
            per_m = _per_m(
                resistance, east, north, is_open, crawl, row, column, cells[k], shares[k],
                steps[k, 1] / norms[k], steps[k, 0] / norms[k],
            )  # fmt: skip
            there = distance[node] + per_m * norms[k] * cell_m
            if there < distance[to]:
                distance[to], before[to] = there, node
                if place[to] < 0:
                    place[to] = size
                    size += 1
                _sift_up(heap, place, distance, to)


@numba.njit(cache=True, nogil=True)
def _sift_up(heap: Any, place: Any, distance: Any, node: int) -> None:
    """Bring a node to its place in the heap, which is no later than the one that it has."""
    at, key = place[node], distance[node]
    while at > 0:
        parent = (at - 1) // 4
        other = heap[parent]
        if distance[other] <= key:
            break
        heap[at], place[other] = other, at
        at = parent
    heap[at], place[node] = node, at


@numba.njit(cache=True, nogil=True)
def _sift_down(heap: Any, place: Any, distance: Any, node: int, size: int) -> None:
    """Bring a node from the top of the heap to its place."""
    at, key = 0, distance[node]
    while True:
        least, best = -1, key
        for child in range(4 * at + 1, min(4 * at + 5, size)):
            if distance[heap[child]] < best:
                least, best = child, distance[heap[child]]
        if least < 0:
            break
        other = heap[least]
        heap[at], place[other] = other, at
        at = least
    heap[at], place[node] = node, at


@numba.njit(cache=True, nogil=True)
def _per_m(
    resistance: Any, east: Any, north: Any, is_open: Any, crawl: float, row: int, column: int, cells: Any, shares: Any,
    x: float, y: float,
) -> float:  # fmt: skip
    """Mean cost per metre in direction x, y over the cells that a step from here touches; inf where one is not open."""
    total = 0.0
    for i in range(len(shares)):
        if shares[i] < 0.0:
            break
        r, c = row + cells[i, 0], column + cells[i, 1]
        if not is_open[r, c]:
            return math.inf
        climbs = resistance[r, c] + east[r, c] * x + north[r, c] * y
        total += shares[i] * (max(climbs, LEAST_COST) if crawl == math.inf else max(climbs / crawl, 1.0))
    return total
