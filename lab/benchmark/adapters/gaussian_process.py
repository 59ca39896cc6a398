"""Gaussian processes by scikit-learn (extra `entries`), one per block of ground.

`python -m lab.benchmark.adapters.gaussian_process BENCH_DATA ENTRY`. Samples are averaged by cell; resistance is
regressed as logarithm, so that concrete counts as much as sand. Lengths and variances are fixed: fitted to soil
borders, they blur them.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from scipy.special import ndtr
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from lab.benchmark.adapters.files import Cell, Column, Map, Samples, by_cell, enter

BLOCK_M, MARGIN_M = 24, 6  # ground of one process, and its margin
LENGTH_M = 2.0
NEAR_M = 2  # predicted cells: within this distance of a sample
# Prior standard deviation, and noise of a cell's mean beyond stated variances: borders, slow position errors.
PRIOR = {"c_rr": (1.3, 0.1), "grade_e": (0.1, 0.01), "grade_n": (0.1, 0.01)}
EDGES = np.log([1e-9, 0.014, 0.03, 0.05, 0.155, 1e9])  # between the five ground classes
LAYERS = {"resistance": "c_rr", "grade_east": "grade_e", "grade_north": "grade_n"}


def gaussian_process(samples: Samples) -> Map:
    """Map of one recording."""
    out: dict[Cell, dict[str, float]] = {}
    for layer, value in LAYERS.items():
        for cell, (mean, std) in _predicted(samples, value).items():
            values = out.setdefault(cell, {})
            values[layer] = math.exp(mean) if value == "c_rr" else mean
            if value == "c_rr":
                values["confidence"] = _likely(mean, std)
    return out


def _likely(mean: float, std: float) -> float:
    """Probability of the mean's ground class."""
    below = ndtr((EDGES - mean) / std)
    kind = int(np.searchsorted(EDGES, mean)) - 1
    return float(below[kind + 1] - below[kind])


def _predicted(samples: Samples, value: str) -> dict[Cell, tuple[float, float]]:
    """Mean and standard deviation of cells near samples, by block."""
    cells = by_cell(samples, value)
    z = np.log(np.maximum(samples[value], 1e-3)) if value == "c_rr" else samples[value]
    places = np.array(sorted(cells))
    means = np.array([z[cells[column, row]].mean() for column, row in places.tolist()])
    counts = np.array([len(cells[column, row]) for column, row in places.tolist()])
    out: dict[Cell, tuple[float, float]] = {}
    for block in {(column // BLOCK_M, row // BLOCK_M) for column, row in cells}:
        corner = np.array(block) * BLOCK_M
        seen = ((places >= corner - MARGIN_M) & (places < corner + BLOCK_M + MARGIN_M)).all(axis=1)
        wanted = _near(places[seen], corner)
        if len(wanted):
            mean, std = _regressed(places[seen], means[seen], counts[seen], wanted, *PRIOR[value])
            out |= {tuple(cell): pair for cell, *pair in zip(wanted.tolist(), mean.tolist(), std.tolist(), strict=True)}
    return out


def _near(places: Column, corner: Column) -> Column:
    """Cells of a block within NEAR_M of a sample."""
    steps = np.arange(-NEAR_M, NEAR_M + 1)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    cells = np.unique((places[:, None] + around).reshape(-1, 2), axis=0)
    return np.asarray(cells[((cells >= corner) & (cells < corner + BLOCK_M)).all(axis=1)])


def _regressed(
    places: Column, means: Column, counts: Column, wanted: Column, prior_std: float, noise_std: float
) -> tuple[Column, Column]:
    kernel = ConstantKernel(prior_std**2, "fixed") * RBF(LENGTH_M, "fixed")
    centre = np.median(means)
    process = GaussianProcessRegressor(kernel, alpha=noise_std**2 * (1 + 1 / counts), optimizer=None)
    process.fit(places, means - centre)
    mean, std = process.predict(wanted, return_std=True)
    return mean + centre, np.hypot(std, noise_std)


if __name__ == "__main__":
    enter(gaussian_process, Path(sys.argv[1]), Path(sys.argv[2]))
