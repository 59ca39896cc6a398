"""The figures of ground estimation: how many classes are right, how large errors are, how long a change takes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evaluation.campaign.figures import root_mean_square
from evaluation.ground.comparison import CellMeans, Comparison, PlacedSamples, grade_errors, is_flat
from evaluation.maps.borders import BorderBin, by_border_distance
from protocol.arrays import Bools, Floats
from protocol.site.ground_classes import UNKNOWN, ZONES, wrong_percent

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
    placed, cells = comparison.placed, comparison.cells
    known, inside = np.isfinite(placed.c_rr), placed.border_m > INTERIOR_M
    measured, interior = np.isfinite(placed.gradient).all(axis=1), cells.border_m > INTERIOR_M
    along_deg, across_deg = (errors[measured & ~placed.is_edge] for errors in grade_errors(placed))
    dirt = np.isin(cells.true, DIRT) & is_flat(cells.slope)
    lag_s, lag_m, place_off_m = (_median(column) for column in comparison.lags.T)
    return GroundFigures(
        right_class_pct=_share(placed.is_right[known]),
        wrong_cells_pct=_wrong(cells),
        wrong_cells_interior_pct=_wrong(cells, interior),
        dirt_flat_right_pct=100 - _wrong(cells, dirt),
        dirt_flat_interior_right_pct=100 - _wrong(cells, dirt & interior),
        lag_s=lag_s,
        lag_m=lag_m,
        place_off_m=place_off_m,
        changes=len(comparison.lags),
        grade_bias_deg=_mean(along_deg),
        grade_std_deg=_std(along_deg),
        across_bias_deg=_mean(across_deg),
        across_std_deg=_std(across_deg),
        grade_excluded_pct=_share(placed.is_edge[measured]),
        wrong_slope_cells_pct=wrong_percent(cells.estimated_slope, cells.true_slope),
        normalised_error=root_mean_square(placed.normalised_error[known & inside]),
        normalised_error_all=root_mean_square(placed.normalised_error[known]),
        cells=int((cells.estimated != UNKNOWN).sum()),
        judged_samples=int(known.sum()),
    )


def soils(cells: CellMeans) -> list[SoilRow]:
    """One row per kind of ground."""
    rows = []
    for i, zone in enumerate(ZONES):
        here = (cells.true == i) & (cells.estimated != UNKNOWN) & (is_flat(cells.slope) | (i not in DIRT))
        counts = {other.name: int((cells.estimated[here] == k).sum()) for k, other in enumerate(ZONES) if k != i}
        wrong = {name: count for name, count in counts.items() if count}
        rows.append(SoilRow(zone.name, int(here.sum()), 100 - _wrong(cells, here), wrong))
    return rows


def c_rr_bias(placed: PlacedSamples) -> float:
    """Mean error of c_rr on flat ground away from borders: what calibration should have removed."""
    return _mean(placed.c_rr_error[np.isfinite(placed.c_rr) & is_flat(placed.slope) & (placed.border_m > INTERIOR_M)])


def by_border(cells: CellMeans) -> list[BorderBin]:
    """Wrong cells by distance from the nearest border."""
    known = cells.estimated != UNKNOWN
    return by_border_distance(cells.estimated[known], cells.true[known], cells.border_m[known])


def _wrong(cells: CellMeans, which: Bools | slice = EVERY) -> float:
    """Share [%] of these cells that is in another class than the truth."""
    return wrong_percent(cells.estimated[which], cells.true[which])


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
