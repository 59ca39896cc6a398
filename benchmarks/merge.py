"""Samples per second of the fold: both kernels, and as a yardstick np.add.at of three plain sums per cell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.measure import SIDE_M, Result, machine, medians, scattered, timed, track
from mapserver.grid import Grid
from mapserver.votes import FoldConfig
from protocol.arrays import Table

PATTERNS = {"track": track, "random": scattered}
BATCH = 100  # what a machine sends every few seconds
# Whole runs in pieces of one large batch; the numpy fallback holds every stencil cell of a piece in memory.
PIECE = 5000
NUMPY_SHARE = 10  # the fallback is so much slower that it is measured on a tenth of the samples


def run(samples: int, runs: int) -> Result:
    """Measure every variant on every pattern."""
    rows = []
    for pattern, make in PATTERNS.items():
        variants = _variants(make(samples))
        for _, work in variants.values():
            work(BATCH)  # compiled, and every block allocated
        whole = medians({name: _timer(work, PIECE) for name, (_, work) in variants.items()}, runs)
        batches = medians({name: _timer(work, BATCH) for name, (_, work) in variants.items()}, runs)
        for name, (n, _) in variants.items():
            rows.append(
                {
                    "variant": name,
                    "pattern": pattern,
                    "msamples_per_s": float(f"{n / whole[name] / 1e6:.3g}"),
                    "us_per_batch_of_100": round(batches[name] / (n / BATCH) * 1e6, 1),
                }
            )
    return {"benchmark": "merge", "samples": samples, "runs": runs, **machine(), "rows": rows}


def _variants(rows: Table) -> dict[str, tuple[int, Callable[[int], None]]]:
    """How many samples each variant folds, and how it folds them in pieces of a given size."""
    few = rows[: max(BATCH, len(rows) // NUMPY_SHARE)]
    return {
        "soft_votes numba": (len(rows), _fold(rows, "numba")),
        "soft_votes numpy": (len(few), _fold(few, "numpy")),
        "np.add.at three sums": (len(rows), _three_sums(rows)),
    }


def _timer(work: Callable[[int], None], piece: int) -> Callable[[], float]:
    return lambda: timed(lambda: work(piece))


def _fold(rows: Table, kernel: str) -> Callable[[int], None]:
    grid = Grid(1.0, FoldConfig(kernel=kernel))

    def work(piece: int) -> None:
        for first in range(0, len(rows), piece):
            grid.fold(rows[first : first + piece], "loader-1")

    return work


def _three_sums(rows: Table) -> Callable[[int], None]:
    """Count, sum and sum of squares of the cell that a sample lies in: no evidence, no covariance."""
    side = int(SIDE_M)
    sums = np.zeros((3, side * side))

    def work(piece: int) -> None:
        for first in range(0, len(rows), piece):
            part = rows[first : first + piece]
            cell = part["y_m"].astype(np.int64) * side + part["x_m"].astype(np.int64)
            value = part["c_rr"].astype(np.float64)
            np.add.at(sums[0], cell, 1.0)
            np.add.at(sums[1], cell, value)
            np.add.at(sums[2], cell, value * value)

    return work
