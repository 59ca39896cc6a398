"""Dijkstra's algorithm over the cells of a window, compiled and without Python's lock.

Edge costs are computed on demand: the graph of a square kilometre would take 300 MB.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

# Cost per metre downhill, as resistance: negative costs would silently give wrong distances.
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
    """Search the cheapest line from source to target: distance (n,), and the cell before each on it.

    Cells are numbered by rows, with a border of closed cells that no step crosses. ground (n, 3): resistance (inf where
    closed), slope east, slope north, interleaved because each access needs all. cells, shares: what steps (k, 2) touch,
    by difference of numbers. distance inf and before -1: not reached.
    """
    norms = np.sqrt((steps * steps).sum(axis=1).astype(np.float64))
    east, north, onward = steps[:, 1] / norms, steps[:, 0] / norms, steps[:, 0] * columns + steps[:, 1]
    heap, keys = np.empty(len(ground), np.int32), np.empty(len(ground))
    place = np.full(len(ground), -1, np.int32)  # index in the heap; -2: settled
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
    """Cost via `here` and one step in direction x, y: the mean of the cells it touches.

    inf if any is closed, or as soon as the cost reaches `known`.
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
