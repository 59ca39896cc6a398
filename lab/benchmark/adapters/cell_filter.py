"""A Kalman filter per cell with a fused read, after robot-centric elevation mapping (Fankhauser 2018).

`python -m lab.benchmark.adapters.cell_filter BENCH_DATA ENTRY`. A sample updates the cell of its stated place; an
outlier raises the cell's variance instead. A read fuses neighbouring cells within the position uncertainty, weighted by
likelihood and variance.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from lab.benchmark.adapters.files import Cell, Map, Samples, by_cell, enter

GATE_SIGMA = 2.5
OUTLIER_VARIANCES = 10.0  # variance added by an outlier, in units of its own
FLOOR_M = 0.3  # smallest position standard deviation
REACH_SIGMA = 2.0  # radius of the fused read
LAYERS = (
    ("resistance", "c_rr", "c_rr_var"),
    ("grade_east", "grade_e", "grade_var"),
    ("grade_north", "grade_n", "grade_var"),
)


def cell_filter(samples: Samples) -> Map:
    """Map of one recording."""
    out: dict[Cell, dict[str, float]] = {}
    for layer, value, variance in LAYERS:
        for cell, fused in _fused(_filtered(samples, value, variance)).items():
            out.setdefault(cell, {})[layer] = fused
    return out


def _filtered(samples: Samples, value: str, variance: str) -> dict[Cell, tuple[float, float, float]]:
    """Estimate, its variance, and mean position variance by cell."""
    cells = {}
    spread = (samples["cov_xx_m2"] + samples["cov_yy_m2"]) / 2
    for cell, rows in by_cell(samples, value).items():
        x, p = math.nan, 0.0
        for z, r in zip(samples[value][rows].tolist(), samples[variance][rows].tolist(), strict=True):
            if math.isnan(x):
                x, p = z, r
            elif (z - x) ** 2 > GATE_SIGMA**2 * (p + r):
                p += OUTLIER_VARIANCES * r
            else:
                gain = p / (p + r)
                x, p = x + gain * (z - x), (1 - gain) * p
        cells[cell] = (x, p, float(spread[rows].mean()) + FLOOR_M**2)
    return cells


def _fused(cells: dict[Cell, tuple[float, float, float]]) -> dict[Cell, float]:
    """All reached cells: mean of the estimates by likelihood and variance."""
    sums: dict[Cell, tuple[float, float]] = {}
    for (column, row), (x, p, place_m2) in cells.items():
        reach = math.ceil(REACH_SIGMA * math.sqrt(place_m2))
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                weight = math.exp(-0.5 * (dx * dx + dy * dy) / place_m2) / p
                value, total = sums.get((column + dx, row + dy), (0.0, 0.0))
                sums[column + dx, row + dy] = value + weight * x, total + weight
    return {cell: value / total for cell, (value, total) in sums.items() if total > np.finfo(float).tiny}


if __name__ == "__main__":
    enter(cell_filter, Path(sys.argv[1]), Path(sys.argv[2]))
