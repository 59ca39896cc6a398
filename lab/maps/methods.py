"""Methods that make one map of the samples of many machines: the map server's own, and what is usual elsewhere.

The others assign a sample to the one cell that its stated position lies in, and know nothing of its covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lab.maps.cases import CELL_M
from lab.maps.samples import Delivery
from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.query.views import read_cells, view_of
from mapserver.trust.auditor import Auditor
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.site.geometry import CellWindow

Layers = dict[str, Floats]  # (rows, columns) by name, NaN where unknown
SERVER_LAYERS = ("resistance", "grade_east", "grade_north", "confidence")
# What a layer is made of: a column, and its variance.
COLUMN = {
    "resistance": ("c_rr", "c_rr_var"),
    "grade_east": ("grade_e", "grade_var"),
    "grade_north": ("grade_n", "grade_var"),
}
GATE_SIGMA = 2.5  # of the Kalman filter
# A rejected value adds so many of its own variances to its cell's, so that a change of the ground is accepted at last.
OUTLIER_VARIANCES = 10.0


def soft_votes(deliveries: Sequence[Delivery], window: CellWindow) -> tuple[Layers, tuple[str, ...]]:
    """The map server's map: its own trust, fold, change test and read, with the options that it has by default.

    Returns its layers, and the machines that it excluded because they contradict all others.
    """
    bad = contradicting(deliveries)
    return folded([(d.machine, d.rows) for d in deliveries if d.machine not in bad], window), bad


def folded(samples: Iterable[tuple[str, Table]], window: CellWindow, names: tuple[str, ...] = SERVER_LAYERS) -> Layers:
    """What the map server makes of samples, machine by machine, all of which it trusts: its fold, change test, read."""
    grid, config = Grid(CELL_M, FoldConfig()), ServerConfig()
    for machine, rows in samples:
        grid.fold(rows, machine)
    values = read_cells(view_of(grid, window, config), window, names, CELL_M, config)
    return {name: layer.astype(np.float64) for name, layer in values.items()}


def contradicting(deliveries: Sequence[Delivery]) -> tuple[str, ...]:
    """Machines that contradict all others, as the server's trust finds them at the end."""
    auditor = Auditor(CELL_M)
    for delivery in deliveries:
        auditor.add(delivery.machine, delivery.rows)
    return tuple(name for name, verdict in auditor.verdicts().items() if verdict.contradicts)


# --- one cell per sample ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hits:
    """Values that fell into cells, oldest first: cell, value and variance (n,). cells: how many there are."""

    cell: Ints
    value: Floats
    variance: Floats
    cells: int


Method = Callable[[Hits], Floats]  # value of each cell (cells,), NaN where there is none


def last_write(hits: Hits) -> Floats:
    """The newest value of each cell, as in the paper."""
    out: Floats = np.full(hits.cells, np.nan)
    out[hits.cell] = hits.value  # where a cell is named twice, numpy keeps the last
    return out


def mean(hits: Hits) -> Floats:
    """Mean of all values of each cell."""
    count = np.bincount(hits.cell, minlength=hits.cells)
    total = np.bincount(hits.cell, hits.value, hits.cells)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def median(hits: Hits) -> Floats:
    """Median of all values of each cell."""
    value = hits.value[np.lexsort((hits.value, hits.cell))]
    count = np.bincount(hits.cell, minlength=hits.cells)
    first = np.cumsum(count) - count
    out: Floats = np.full(hits.cells, np.nan)
    known = np.flatnonzero(count)
    lower, upper = (first + (count - 1) // 2)[known], (first + count // 2)[known]
    out[known] = (value[lower] + value[upper]) / 2
    return out


def kalman(hits: Hits) -> Floats:
    """A Kalman filter of one state per cell with a gate, as elevation mapping has it (Fankhauser et al. 2014).

    A value beyond GATE_SIGMA is rejected, and makes the cell less sure instead. The k-th values of all cells are
    filtered at once.
    """
    x: Floats = np.full(hits.cells, np.nan)
    P = np.zeros(hits.cells)
    for turn in _turns(hits.cell):
        cell, z, R = hits.cell[turn], hits.value[turn], hits.variance[turn]
        if np.isnan(x[cell[0]]):  # the first turn, and only it, meets cells that are empty
            x[cell], P[cell] = z, R
            continue
        innovation = z - x[cell]
        accepted: Bools = innovation**2 <= GATE_SIGMA**2 * (P[cell] + R)
        K = np.where(accepted, P[cell] / (P[cell] + R), 0.0)
        x[cell] += K * innovation
        P[cell] = np.where(accepted, (1 - K) * P[cell], P[cell] + OUTLIER_VARIANCES * R)
    return x


def _turns(cell: Ints) -> list[Ints]:
    """Indices of the first values of all cells, of the second ones, and so on."""
    order = np.argsort(cell, kind="stable")
    count = np.bincount(cell)
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    by_rank = np.argsort(rank, kind="stable")
    return np.split(by_rank, np.cumsum(np.bincount(rank))[:-1]) if len(cell) else []


METHODS: dict[str, Method] = {"last_write": last_write, "mean": mean, "median": median, "kalman": kalman}


def in_order(tables: Iterable[Table]) -> Table:
    """All samples of some tables, oldest first."""
    rows = np.concatenate(list(tables))
    return rows[np.argsort(rows["stamp_ns"], kind="stable")]


def hits_of(rows: Table, layer: str, window: CellWindow) -> Hits:
    """What a layer's column puts into the cells of a window, row by row from the south."""
    value, variance = COLUMN[layer]
    column = np.floor(rows["x_m"] / CELL_M).astype(np.int64) - window.column
    row = np.floor(rows["y_m"] / CELL_M).astype(np.int64) - window.row
    inside = (column >= 0) & (column < window.columns) & (row >= 0) & (row < window.rows) & np.isfinite(rows[value])
    cell = row[inside] * window.columns + column[inside]
    values, variances = (rows[name][inside].astype(np.float64) for name in (value, variance))
    return Hits(cell, values, variances, window.rows * window.columns)


def merge_hard(method: Method, rows: Table, names: Sequence[str], window: CellWindow) -> Layers:
    """Layers (rows, columns) that a method makes of samples that lie oldest first."""
    shape = (window.rows, window.columns)
    return {name: method(hits_of(rows, name, window)).reshape(shape) for name in names}
