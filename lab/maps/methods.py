"""Merge methods: the map server's own, and usual ones.

The latter assign a sample to the cell of its stated position and ignore the covariance.
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

Layers = dict[str, Floats]  # (rows, columns) by name, NaN unknown
SERVER_LAYERS = ("resistance", "grade_east", "grade_north", "confidence")
# Source of a layer: column, variance.
COLUMN = {
    "resistance": ("c_rr", "c_rr_var"),
    "grade_east": ("grade_e", "grade_var"),
    "grade_north": ("grade_n", "grade_var"),
}
GATE_SIGMA = 2.5  # of the Kalman filter
# Variance added by an outlier, in units of its own, so that changes are accepted eventually.
OUTLIER_VARIANCES = 10.0


def soft_votes(deliveries: Sequence[Delivery], window: CellWindow) -> tuple[Layers, tuple[str, ...]]:
    """The map server's default trust, fold, change test and read.

    Returns its layers, and machines excluded for contradicting all others.
    """
    bad = contradicting(deliveries)
    return folded([(d.machine, d.rows) for d in deliveries if d.machine not in bad], window), bad


def folded(samples: Iterable[tuple[str, Table]], window: CellWindow, names: tuple[str, ...] = SERVER_LAYERS) -> Layers:
    """The map server's layers of samples by machine, all trusted."""
    grid, config = Grid(CELL_M, FoldConfig()), ServerConfig()
    for machine, rows in samples:
        grid.fold(rows, machine)
    values = read_cells(view_of(grid, window, config), window, names, CELL_M, config)
    return {name: layer.astype(np.float64) for name, layer in values.items()}


def contradicting(deliveries: Sequence[Delivery]) -> tuple[str, ...]:
    """Machines that the server's trust finally excludes."""
    auditor = Auditor(CELL_M)
    for delivery in deliveries:
        auditor.add(delivery.machine, delivery.rows)
    return tuple(name for name, verdict in auditor.verdicts().items() if verdict.contradicts)


# --- one cell per sample ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hits:
    """Values by cell, oldest first: cell, value, variance (n,). cells: total."""

    cell: Ints
    value: Floats
    variance: Floats
    cells: int


Method = Callable[[Hits], Floats]  # value per cell (cells,), NaN without


def last_write(hits: Hits) -> Floats:
    """Newest value per cell, as in the paper."""
    out: Floats = np.full(hits.cells, np.nan)
    out[hits.cell] = hits.value  # numpy keeps the last of repeated indices
    return out


def mean(hits: Hits) -> Floats:
    """Mean per cell."""
    count = np.bincount(hits.cell, minlength=hits.cells)
    total = np.bincount(hits.cell, hits.value, hits.cells)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def median(hits: Hits) -> Floats:
    """Median per cell."""
    value = hits.value[np.lexsort((hits.value, hits.cell))]
    count = np.bincount(hits.cell, minlength=hits.cells)
    first = np.cumsum(count) - count
    out: Floats = np.full(hits.cells, np.nan)
    known = np.flatnonzero(count)
    lower, upper = (first + (count - 1) // 2)[known], (first + count // 2)[known]
    out[known] = (value[lower] + value[upper]) / 2
    return out


def kalman(hits: Hits) -> Floats:
    """A gated one-state Kalman filter per cell, as in elevation mapping (Fankhauser et al. 2014).

    Values beyond GATE_SIGMA are rejected and raise the cell's variance. The k-th values of all cells are filtered at
    once.
    """
    x: Floats = np.full(hits.cells, np.nan)
    P = np.zeros(hits.cells)
    for turn in _turns(hits.cell):
        cell, z, R = hits.cell[turn], hits.value[turn], hits.variance[turn]
        if np.isnan(x[cell[0]]):  # only the first turn meets empty cells
            x[cell], P[cell] = z, R
            continue
        innovation = z - x[cell]
        accepted: Bools = innovation**2 <= GATE_SIGMA**2 * (P[cell] + R)
        K = np.where(accepted, P[cell] / (P[cell] + R), 0.0)
        x[cell] += K * innovation
        P[cell] = np.where(accepted, (1 - K) * P[cell], P[cell] + OUTLIER_VARIANCES * R)
    return x


def _turns(cell: Ints) -> list[Ints]:
    """Indices of all cells' first values, second values, and so on."""
    order = np.argsort(cell, kind="stable")
    count = np.bincount(cell)
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    by_rank = np.argsort(rank, kind="stable")
    return np.split(by_rank, np.cumsum(np.bincount(rank))[:-1]) if len(cell) else []


METHODS: dict[str, Method] = {"last_write": last_write, "mean": mean, "median": median, "kalman": kalman}


def in_order(tables: Iterable[Table]) -> Table:
    """Samples of several tables, oldest first."""
    rows = np.concatenate(list(tables))
    return rows[np.argsort(rows["stamp_ns"], kind="stable")]


def hits_of(rows: Table, layer: str, window: CellWindow) -> Hits:
    """A layer's values in a window's cells, row by row from the south."""
    value, variance = COLUMN[layer]
    column = np.floor(rows["x_m"] / CELL_M).astype(np.int64) - window.column
    row = np.floor(rows["y_m"] / CELL_M).astype(np.int64) - window.row
    inside = (column >= 0) & (column < window.columns) & (row >= 0) & (row < window.rows) & np.isfinite(rows[value])
    cell = row[inside] * window.columns + column[inside]
    values, variances = (rows[name][inside].astype(np.float64) for name in (value, variance))
    return Hits(cell, values, variances, window.rows * window.columns)


def merge_hard(method: Method, rows: Table, names: Sequence[str], window: CellWindow) -> Layers:
    """Layers (rows, columns) of a method from samples, oldest first."""
    shape = (window.rows, window.columns)
    return {name: method(hits_of(rows, name, window)).reshape(shape) for name in names}
