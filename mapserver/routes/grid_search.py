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
    ground: Any,
    columns: int,
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

    Cells are numbered row by row, with a border of closed ones that no step leads across. ground (n, 3): resistance,
    inf where closed, and slopes to the east and north, side by side, as each look at a cell takes all of them. cells,
    shares: what steps (k, 2) touch, by the difference of numbers. distance (n,): inf, before (n,): -1, where no line
    leads or none was looked for.
    """
    norms = np.sqrt((steps * steps).sum(axis=1).astype(np.float64))
    east, north, onward = steps[:, 1] / norms, steps[:, 0] / norms, steps[:, 0] * columns + steps[:, 1]
    heap, keys = np.empty(len(ground), np.int32), np.empty(len(ground))
    place = np.full(len(ground), -1, np.int32)  # -2: settled
    distance[source], heap[0], keys[0], place[source], size = 0.0, source, 0.0, 0, 1
    while size > 0:
        node = heap[0]
        if node == target:
            return
        size -= 1
        place[node] = -2
        if size > 0:
            _sift_down(heap, keys, place, heap[size], keys[size], size)
        for k in range(len(steps)):
            to = node + onward[k]
            if place[to] == -2 or ground[to, 0] == math.inf:
                continue
            there = _there(
                ground, crawl, node, cells[k], shares[k], east[k], north[k], distance[node], norms[k], cell_m,
                distance[to],
            )  # fmt: skip
            if there < distance[to]:
                distance[to], before[to] = there, node
                if place[to] < 0:
                    place[to] = size
                    size += 1
                _sift_up(heap, keys, place, to, there)


@numba.njit(cache=True, nogil=True)
def _sift_up(heap: Any, keys: Any, place: Any, node: int, key: float) -> None:
    """Bring a node to its place in the heap, which is no later than the one that it has."""
    at = place[node]
    while at > 0:
        parent = (at - 1) // 4
        if keys[parent] <= key:
            break
        heap[at], keys[at] = heap[parent], keys[parent]
        place[heap[at]] = at
        at = parent
    heap[at], keys[at], place[node] = node, key, at


@numba.njit(cache=True, nogil=True)
def _sift_down(heap: Any, keys: Any, place: Any, node: int, key: float, size: int) -> None:
    """Bring a node from the top of the heap to its place."""
    at = 0
    while True:
        least, best = -1, key
        for child in range(4 * at + 1, min(4 * at + 5, size)):
            if keys[child] < best:
                least, best = child, keys[child]
        if least < 0:
            break
        heap[at], keys[at] = heap[least], best
        place[heap[at]] = at
        at = least
    heap[at], keys[at], place[node] = node, key, at


@numba.njit(cache=True, nogil=True)
def _there(
    ground: Any, crawl: float, node: int, cells: Any, shares: Any, x: float, y: float, here: float, norm: float,
    cell_m: float, known: float,
) -> float:  # fmt: skip
    """Cost of a line by way of here, one step further in direction x, y: the mean per metre of the cells it touches.

    inf where one of these is closed, or the cost at least what is known: what they cost only adds up.
    """
    total, there = 0.0, here
    for i in range(len(shares)):
        if shares[i] < 0.0:
            break
        cell = node + cells[i]
        if ground[cell, 0] == math.inf:
            return math.inf
        climbs = ground[cell, 0] + ground[cell, 1] * x + ground[cell, 2] * y
        total += shares[i] * (max(climbs, LEAST_COST) if crawl == math.inf else max(climbs / crawl, 1.0))
        there = here + total * norm * cell_m
        if there >= known:
            return math.inf
    return there
