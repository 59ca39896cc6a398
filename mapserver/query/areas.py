"""Outlines and larger cells of regions, as pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Bools, Floats32
from protocol.errors import QueryError, Refusal
from protocol.queries.places import Place
from protocol.site.geometry import CellWindow


def cells_to_a_side(resolution_m: float | None, cell_m: float) -> int:
    """Map cells to a side of a larger one; QueryError if they do not divide it."""
    if resolution_m is None:
        return 1
    count = round(resolution_m / cell_m)
    if count < 1 or abs(resolution_m - count * cell_m) > 1e-9 * resolution_m:
        problem = f"parameter `resolution`: {resolution_m:g} m is no multiple of the cell's {cell_m:g} m"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    return count


def finer(window: CellWindow, count: int) -> CellWindow:
    """The same window in cells `count` times smaller."""
    return CellWindow(window.column * count, window.row * count, window.columns * count, window.rows * count)


def means(values: Floats32, count: int) -> Floats32:
    """Mean of known values in squares of count x count cells; NaN for none."""
    rows, columns = values.shape
    squares = values.reshape(rows // count, count, columns // count, count).astype(np.float64)
    known = np.isfinite(squares)
    total, number = np.where(known, squares, 0.0).sum(axis=(1, 3)), known.sum(axis=(1, 3))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan).astype(np.float32)


def inside(outline: Sequence[Place], window: CellWindow, cell_m: float) -> Bools:
    """Cells (rows, columns) with centres in an outline: an odd number of its sides lies to the west.

    Of two outlines with a common side, exactly one has a centre near it.
    """
    crossings = np.zeros((window.rows, window.columns + 1), np.int64)
    corners = np.array(outline) / cell_m - 0.5 - (window.column, window.row)  # in cells, from the first centre
    for (x, y), (to_x, to_y) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        low, high = min(y, to_y), max(y, to_y)
        rows = np.arange(max(0, np.ceil(low)), min(window.rows, np.ceil(high)), dtype=np.int64)
        if rows.size:
            at = x + (rows - y) / (to_y - y) * (to_x - x)
            crossings[rows, np.clip(np.ceil(at), 0, window.columns).astype(np.int64)] += 1
    return np.asarray(np.cumsum(crossings, axis=1)[:, :-1] % 2 == 1)
