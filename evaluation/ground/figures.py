"""The figures of ground estimation: how many classes are right, how large errors are, how long a change takes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evaluation.campaign.figures import root_mean_square
from evaluation.ground.comparison import Comparison
from evaluation.maps.borders import BorderBin, by_border_distance
from protocol.arrays import Bools, Floats
from protocol.site.ground_classes import ZONES, wrong_percent

INTERIOR_M = 2.0  # the load centre this far from a border has all wheels on one kind of ground
EVERY = slice(None)
DIRT = tuple(i for i, zone in enumerate(ZONES) if "dirt" in zone.name)


@dataclass(frozen=True)
class GroundFigures:
    """Figures of one estimator and preset; NaN where nothing was to be judged. docs/evaluation.md explains each."""

    right_class_pct: float
    wrong_cells_pct: float
    wrong_cells_interior_pct: float
    dirt_flat_right_pct: float
    dirt_flat_interior_right_pct: float
    lag_s: float
    lag_m: float
    place_off_m: float
    changes: int
    grade_bias_deg: float
    grade_std_deg: float
    across_bias_deg: float
    across_std_deg: float
    grade_excluded_pct: float
    wrong_slope_cells_pct: float
    normalised_error: float
    normalised_error_all: float
    cells: int
    judged_samples: int


@dataclass(frozen=True)
class SoilRow:
    """How many cells of one kind of ground are right, and what the others were taken for; of dirt, flat cells alone."""

    name: str
    cells: int
    right_pct: float
    taken_for: dict[str, int]


def figures(comparison: Comparison) -> GroundFigures:
    """The figures of a comparison."""
    interior, inside = comparison.cell_border_m > INTERIOR_M, comparison.border_m > INTERIOR_M
    normalised = comparison.c_rr_error / comparison.c_rr_std
    lag_s, lag_m, place_off_m = (_median(column) for column in comparison.lags.T)
    dirt = np.isin(comparison.cell_true, DIRT) & comparison.cell_flat
    return GroundFigures(
        right_class_pct=_share(comparison.class_right),
        wrong_cells_pct=_wrong(comparison),
        wrong_cells_interior_pct=_wrong(comparison, interior),
        dirt_flat_right_pct=100 - _wrong(comparison, dirt),
        dirt_flat_interior_right_pct=100 - _wrong(comparison, dirt & interior),
        lag_s=lag_s,
        lag_m=lag_m,
        place_off_m=place_off_m,
        changes=len(comparison.lags),
        grade_bias_deg=_mean(comparison.along_deg),
        grade_std_deg=_std(comparison.along_deg),
        across_bias_deg=_mean(comparison.across_deg),
        across_std_deg=_std(comparison.across_deg),
        grade_excluded_pct=_share(comparison.edge),
        wrong_slope_cells_pct=wrong_percent(comparison.slope_estimated, comparison.slope_true),
        normalised_error=root_mean_square(normalised[inside]),
        normalised_error_all=root_mean_square(normalised),
        cells=len(comparison.cell_estimated),
        judged_samples=len(comparison.class_right),
    )


def soils(comparison: Comparison) -> list[SoilRow]:
    """One row per kind of ground."""
    rows = []
    for i, zone in enumerate(ZONES):
        here = (comparison.cell_true == i) & (comparison.cell_flat | (i not in DIRT))
        estimated = comparison.cell_estimated[here]
        counts = {other.name: int((estimated == k).sum()) for k, other in enumerate(ZONES) if k != i}
        wrong = {name: count for name, count in counts.items() if count}
        rows.append(SoilRow(zone.name, int(here.sum()), 100 - _wrong(comparison, here), wrong))
    return rows


def c_rr_bias(comparison: Comparison) -> float:
    """Mean error of c_rr on flat ground away from borders: what calibration should have removed."""
    return _mean(comparison.c_rr_error[comparison.is_flat & (comparison.border_m > INTERIOR_M)])


def by_border(comparison: Comparison) -> list[BorderBin]:
    """Wrong cells by distance from the nearest border."""
    return by_border_distance(comparison.cell_estimated, comparison.cell_true, comparison.cell_border_m)


def _wrong(comparison: Comparison, which: Bools | slice = EVERY) -> float:
    """Share [%] of these cells that is in another class than the truth."""
    return wrong_percent(comparison.cell_estimated[which], comparison.cell_true[which])


def _share(flags: Bools) -> float:
    return 100.0 * float(flags.mean()) if len(flags) else math.nan


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan


def _std(values: Floats) -> float:
    return float(values.std()) if len(values) else math.nan


def _median(values: Floats) -> float:
    """The median; NaN of nothing, or where more than half are infinite."""
    middle = float(np.median(values)) if len(values) else math.nan
    return middle if math.isfinite(middle) else math.nan
