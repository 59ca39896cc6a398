"""Gap filling by kernel inference: estimates of undriven cells, with uncertainty.

Known cells vote for those around, with weights that fall to zero at the kernel's reach: Bayesian generalised kernel
inference (Shan, Wang, Englot, Doherty, "Bayesian Generalized Kernel Inference for Terrain Traversability Mapping", CoRL
2018), sparse kernel of Melkumyan and Ramos ("A Sparse Covariance Function for Exact Gaussian Process Inference in Large
Datasets", IJCAI 2009). Known cells keep their values. Windows are (rows, columns), NaN where unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mapserver.error_model import GRADE_PRIOR_STD, RESISTANCE_PRIOR_STD
from protocol.arrays import Bools, Floats

PRIOR_M2 = 0.1  # weight of the prior, as certain ground at the cell
HALF_SURE_M = 1.0  # metres that count half: more say no more about ground beside
# Least evidence [m2]: beyond 0.94 of the reach a cell has no effect, and filters' rounding is far below.
LEAST_M2 = 1e-5


def sparse_kernel(reach_m: float, cell_m: float) -> Floats:
    """Kernel (k, k), k odd, times cell area [m2], to be independent of cell size.

    With u = distance / reach: (2 + cos 2 pi u) (1 - u) / 3 + sin(2 pi u) / (2 pi) for u < 1, else 0.
    """
    half = math.ceil(reach_m / cell_m)
    axis = np.arange(-half, half + 1) * cell_m
    u = np.minimum(np.hypot(axis[:, None], axis[None, :]) / reach_m, 1.0)
    turn = 2 * np.pi * u
    kernel: Floats = ((2 + np.cos(turn)) * (1 - u) / 3 + np.sin(turn) / (2 * np.pi)) * cell_m**2
    return kernel


def cell_weights(values: Floats, weight_m: Floats, std: Floats, prior_std: float) -> Floats:
    """Weights of cells, 0 to 1: half at HALF_SURE_M of evidence, and at the prior's spread; 0 for NaN.

    Saturated, because a hundred passes say no more about neighbours than ten.
    """
    weights: Floats = weight_m / (weight_m + HALF_SURE_M) / (1 + (std / prior_std) ** 2)
    return np.where(np.isfinite(values), weights, 0.0)


def fill_by_mean(values: Floats, weights: Floats, kernel: Floats) -> Floats:
    """Fill with the mean of neighbours."""
    area = _smooth(weights, kernel)
    total = _smooth(weights * np.nan_to_num(values), kernel)
    return _keep_known(values, area, total / np.maximum(area, LEAST_M2))


def fill_by_majority(values: Floats, weights: Floats, kernel: Floats, boundaries: Sequence[float]) -> Floats:
    """Fill with the weighted mean of neighbours in the leading class.

    Between concrete (0.008) and sand (0.25) a plain mean would invent dirt. boundaries: increasing, as values.
    """
    classes = np.digitize(values, boundaries)
    leading, best = np.zeros(values.shape), np.full(values.shape, np.nan)
    area = np.zeros(values.shape)
    for index in range(len(boundaries) + 1):
        own = np.where(classes == index, weights, 0.0)
        if not own.any():
            continue
        # rounded: filters' rounding, which depends on the window, must not decide ties
        votes = _smooth(own, kernel).round(9)
        mean = _smooth(own * np.nan_to_num(values), kernel) / np.maximum(votes, LEAST_M2)
        best = np.where(votes > leading, mean, best)
        leading, area = np.maximum(leading, votes), area + votes
    return _keep_known(values, np.where(leading >= LEAST_M2, area, 0.0), best)


def filled_std(
    values: Floats, std: Floats, weights: Floats, filled: Floats, prior_std: float, kernel: Floats
) -> Floats:
    """Posterior standard deviation of filled cells; known cells keep theirs.

    Weighted second moment of neighbours about the filled value, with their variances, and the prior as an area
    PRIOR_M2: it grows with distance, up to the prior's, and with disagreement.
    """
    x = np.nan_to_num(values)
    area = _smooth(weights, kernel)
    first = _smooth(weights * x, kernel)
    second = _smooth(weights * (x**2 + np.nan_to_num(std) ** 2), kernel)
    moment = np.maximum(second - 2 * filled * first + filled**2 * area, 0.0)
    deviation: Floats = np.sqrt((moment + PRIOR_M2 * prior_std**2) / (area + PRIOR_M2))
    known = np.isfinite(values)
    return np.where(known, std, np.where(np.isfinite(filled), deviation, np.nan))


def _keep_known(values: Floats, area: Floats, estimate: Floats) -> Floats:
    known: Bools = np.isfinite(values)
    return np.where(known, values, np.where(area >= LEAST_M2, estimate, np.nan))


def _smooth(image: Floats, kernel: Floats) -> Floats:
    """Empty outside the window."""
    out: Floats = np.asarray(cv2.filter2D(image, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT), np.float64)
    return out


# --- the layers -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Area:
    """Input of an area layer. layers: (rows, columns). reach_m, boundaries: read options."""

    layers: Mapping[str, Floats]
    cell_m: float
    reach_m: float
    boundaries: tuple[float, ...]

    def __getitem__(self, name: str) -> Floats:
        return self.layers[name]

    @property
    def kernel(self) -> Floats:
        """The filling kernel for these cells."""
        return sparse_kernel(self.reach_m, self.cell_m)


@dataclass(frozen=True)
class AreaLayer:
    """A layer derived from others around each cell."""

    needs: tuple[str, ...]
    derive: Callable[[Area], Floats]


def resistance_filled(area: Area) -> Floats:
    """`resistance`; gaps get the log mean of the leading class around."""
    log, _, weights = _log_resistance(area)
    return np.exp(fill_by_majority(log, weights, area.kernel, np.log(area.boundaries).tolist()))


def resistance_filled_std(area: Area) -> Floats:
    """Standard deviation [-]; `resistance_std` in known cells."""
    log, std, weights = _log_resistance(area)
    filled = area["resistance_filled"]
    return filled * filled_std(log, std, weights, np.log(filled), RESISTANCE_PRIOR_STD, area.kernel)


def resistance_class_filled(area: Area) -> Floats:
    """`resistance_class`; gaps by `resistance_filled`."""
    filled = area["resistance_filled"]
    classes = np.where(np.isfinite(filled), np.digitize(filled, area.boundaries), np.nan)
    known = np.isfinite(area["resistance"])
    return np.where(known, area["resistance_class"], classes)


def grade_east_filled(area: Area) -> Floats:
    """`grade_east`, gaps filled."""
    return fill_by_mean(area["grade_east"], _grade_weights(area), area.kernel)


def grade_north_filled(area: Area) -> Floats:
    """`grade_north`, gaps filled."""
    return fill_by_mean(area["grade_north"], _grade_weights(area), area.kernel)


def grade_filled(area: Area) -> Floats:
    """Steepness of the filled gradient [m/m]."""
    return np.hypot(area["grade_east_filled"], area["grade_north_filled"])


def grade_filled_std(area: Area) -> Floats:
    """Standard deviation of a gradient component [m/m]; `grade_std` in known cells."""
    std, weights, kernel = area["grade_std"], _grade_weights(area), area.kernel
    east, north = (
        filled_std(area[name], std, weights, area[f"{name}_filled"], GRADE_PRIOR_STD, kernel)
        for name in ("grade_east", "grade_north")
    )
    return np.hypot(east, north) / math.sqrt(2)


def _log_resistance(area: Area) -> tuple[Floats, Floats, Floats]:
    """Log(c_rr), its standard deviation, and weights."""
    log, std = np.log(area["resistance"]), area["resistance_std"] / area["resistance"]
    return log, std, cell_weights(log, area["weight"], std, RESISTANCE_PRIOR_STD)


def _grade_weights(area: Area) -> Floats:
    # samples have both components or none
    return cell_weights(area["grade_east"], area["weight"], area["grade_std"], GRADE_PRIOR_STD)


_RESISTANCE, _GRADE = ("resistance", "resistance_std", "weight"), ("grade_east", "grade_north", "grade_std", "weight")
AREA_LAYERS: dict[str, AreaLayer] = {
    "resistance_filled": AreaLayer(_RESISTANCE, resistance_filled),
    "resistance_filled_std": AreaLayer((*_RESISTANCE, "resistance_filled"), resistance_filled_std),
    "resistance_class_filled": AreaLayer(
        ("resistance", "resistance_class", "resistance_filled"), resistance_class_filled
    ),
    "grade_east_filled": AreaLayer(_GRADE, grade_east_filled),
    "grade_north_filled": AreaLayer(_GRADE, grade_north_filled),
    "grade_filled": AreaLayer(("grade_east_filled", "grade_north_filled"), grade_filled),
    "grade_filled_std": AreaLayer((*_GRADE, "grade_east_filled", "grade_north_filled"), grade_filled_std),
}
