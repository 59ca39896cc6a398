"""Filling of gaps by kernel inference: an estimate for cells that nobody drove, and its uncertainty.

Known cells vote for the unknown ones around them, each with a weight that falls to zero at the kernel's reach: Bayesian
generalised kernel inference (Shan, Wang, Englot, Doherty, "Bayesian Generalized Kernel Inference for Terrain
Traversability Mapping", CoRL 2018) with the sparse kernel of Melkumyan and Ramos ("A Sparse Covariance Function for
Exact Gaussian Process Inference in Large Datasets", IJCAI 2009). Known cells keep what they have. Windows are
(rows, columns), NaN where unknown; pure functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mapserver.error_model import GRADE_PRIOR_STD, RESISTANCE_PRIOR_STD
from protocol.arrays import Bools, Floats

PRIOR_M2 = 0.1  # the prior weighs as much as this area of sure ground right at the cell
HALF_SURE_M = 1.0  # a cell with so many metres of evidence counts half: more do not describe the ground beside it
# Less evidence than this [m2] is none: beyond 0.94 of the reach a single cell has no effect, and the filters' rounding
# stays far below what counts.
LEAST_M2 = 1e-5


def sparse_kernel(reach_m: float, cell_m: float) -> Floats:
    """Kernel (k, k), k odd, in m2: its value times the area of a cell, so that the size of cells does not matter.

    With u = distance / reach: (2 + cos 2 pi u) (1 - u) / 3 + sin(2 pi u) / (2 pi) for u < 1, else 0; 1 at the centre.
    """
    half = math.ceil(reach_m / cell_m)
    axis = np.arange(-half, half + 1) * cell_m
    u = np.minimum(np.hypot(axis[:, None], axis[None, :]) / reach_m, 1.0)
    turn = 2 * np.pi * u
    kernel: Floats = ((2 + np.cos(turn)) * (1 - u) / 3 + np.sin(turn) / (2 * np.pi)) * cell_m**2
    return kernel


def cell_weights(values: Floats, weight_m: Floats, std: Floats, prior_std: float) -> Floats:
    """How much each known cell counts, 0 to 1: half with HALF_SURE_M of evidence, half with votes as wide as the prior.

    Saturates, because a hundred passes over one cell say no more about its neighbours than ten. 0 where values are NaN.
    """
    weights: Floats = weight_m / (weight_m + HALF_SURE_M) / (1 + (std / prior_std) ** 2)
    return np.where(np.isfinite(values), weights, 0.0)


def fill_by_mean(values: Floats, weights: Floats, kernel: Floats) -> Floats:
    """Fill with the weighted mean of the neighbours."""
    area = _smooth(weights, kernel)
    total = _smooth(weights * np.nan_to_num(values), kernel)
    return _keep_known(values, area, total / np.maximum(area, LEAST_M2))


def fill_by_majority(values: Floats, weights: Floats, kernel: Floats, boundaries: Sequence[float]) -> Floats:
    """Fill with the weighted mean of those neighbours that are of the leading class.

    Between concrete (0.008) and sand (0.25) a mean would invent dirt that is nowhere near: classes vote first.
    boundaries: increasing, in the unit of the values.
    """
    classes = np.digitize(values, boundaries)
    leading, best = np.zeros(values.shape), np.full(values.shape, np.nan)
    area = np.zeros(values.shape)
    for index in range(len(boundaries) + 1):
        own = np.where(classes == index, weights, 0.0)
        if not own.any():
            continue
        # rounded: equal votes must not be decided by the filters' rounding, which differs with the window
        votes = _smooth(own, kernel).round(9)
        mean = _smooth(own * np.nan_to_num(values), kernel) / np.maximum(votes, LEAST_M2)
        best = np.where(votes > leading, mean, best)
        leading, area = np.maximum(leading, votes), area + votes
    return _keep_known(values, np.where(leading >= LEAST_M2, area, 0.0), best)


def filled_std(
    values: Floats, std: Floats, weights: Floats, filled: Floats, prior_std: float, kernel: Floats
) -> Floats:
    """Posterior standard deviation of filled cells; known cells keep their own.

    The weighted second moment of the neighbours about the filled value, their own variances included, with the prior
    as one more neighbour of area PRIOR_M2. So it grows with the distance to evidence up to the prior's, and where
    neighbours disagree.
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
    """Sum over the kernel; nothing is known outside the window."""
    out: Floats = np.asarray(cv2.filter2D(image, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT), np.float64)
    return out


# --- the layers -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Area:
    """What an area layer is derived from.

    layers: those that it needs, (rows, columns). reach_m, boundaries: fill_reach_m and boundaries of the read options.
    """

    layers: Mapping[str, Floats]
    cell_m: float
    reach_m: float
    boundaries: tuple[float, ...]

    def __getitem__(self, name: str) -> Floats:
        return self.layers[name]

    @property
    def kernel(self) -> Floats:
        """The filling kernel at this size of cells."""
        return sparse_kernel(self.reach_m, self.cell_m)


@dataclass(frozen=True)
class AreaLayer:
    """A layer that needs others, of cells or areas, around each cell."""

    needs: tuple[str, ...]
    derive: Callable[[Area], Floats]


def resistance_filled(area: Area) -> Floats:
    """`resistance`, gaps filled with the mean, in log(c_rr), of the class that leads around them."""
    log, _, weights = _log_resistance(area)
    return np.exp(fill_by_majority(log, weights, area.kernel, np.log(area.boundaries).tolist()))


def resistance_filled_std(area: Area) -> Floats:
    """Standard deviation of `resistance_filled` [-]; `resistance_std` in known cells."""
    log, std, weights = _log_resistance(area)
    filled = area["resistance_filled"]
    return filled * filled_std(log, std, weights, np.log(filled), RESISTANCE_PRIOR_STD, area.kernel)


def resistance_class_filled(area: Area) -> Floats:
    """`resistance_class`, gaps filled with the class of `resistance_filled`."""
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
    """Standard deviation of one component of the filled gradient [m/m]; `grade_std` in known cells."""
    std, weights, kernel = area["grade_std"], _grade_weights(area), area.kernel
    east, north = (
        filled_std(area[name], std, weights, area[f"{name}_filled"], GRADE_PRIOR_STD, kernel)
        for name in ("grade_east", "grade_north")
    )
    return np.hypot(east, north) / math.sqrt(2)


def _log_resistance(area: Area) -> tuple[Floats, Floats, Floats]:
    """Log(c_rr), its standard deviation and the cells' weights."""
    log, std = np.log(area["resistance"]), area["resistance_std"] / area["resistance"]
    return log, std, cell_weights(log, area["weight"], std, RESISTANCE_PRIOR_STD)


def _grade_weights(area: Area) -> Floats:
    # a sample has both components or none, so one of them tells which cells are known
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
