"""Figures of ground estimation: right classes, errors, lag. Explained in lab/README.md; NaN: nothing to judge."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lab.ground.comparison import CellMeans, Comparison, PlacedSamples, grade_errors, is_flat
from protocol.arrays import AnyArray, Bools
from protocol.site.ground_classes import UNKNOWN, ZONES, wrong_percent
from sitegrid.proof.figures import Row, root_mean_square
from sitegrid.proof.map_score import by_border_distance

INTERIOR_M = 2.0  # all wheels on one ground class if the load centre is this far from borders
EVERY = slice(None)
DIRT = tuple(i for i, zone in enumerate(ZONES) if "dirt" in zone.name)


def figures(comparison: Comparison) -> Row:
    """Figures of a comparison."""
    placed, cells = comparison.placed, comparison.cells
    known, inside = np.isfinite(placed.c_rr), placed.border_m > INTERIOR_M
    measured, interior = np.isfinite(placed.gradient).all(axis=1), cells.border_m > INTERIOR_M
    along_deg, across_deg = (errors[measured & ~placed.is_edge] for errors in grade_errors(placed))
    dirt = np.isin(cells.true, DIRT) & is_flat(cells.slope)
    lag_s, lag_m, place_off_m = (_finite(np.median, column) for column in comparison.lags.T)
    return {
        "right_class_pct": _share(placed.is_right[known]),
        "wrong_cells_pct": _wrong(cells),
        "wrong_cells_interior_pct": _wrong(cells, interior),
        "dirt_flat_right_pct": 100 - _wrong(cells, dirt),
        "dirt_flat_interior_right_pct": 100 - _wrong(cells, dirt & interior),
        "lag_s": lag_s,
        "lag_m": lag_m,
        "place_off_m": place_off_m,
        "changes": len(comparison.lags),
        "grade_bias_deg": _finite(np.mean, along_deg),
        "grade_std_deg": _finite(np.std, along_deg),
        "across_bias_deg": _finite(np.mean, across_deg),
        "across_std_deg": _finite(np.std, across_deg),
        "grade_excluded_pct": _share(placed.is_edge[measured]),
        "wrong_slope_cells_pct": wrong_percent(cells.estimated_slope, cells.true_slope),
        "normalised_error": root_mean_square(placed.normalised_error[known & inside]),
        "normalised_error_all": root_mean_square(placed.normalised_error[known]),
        "cells": int((cells.estimated != UNKNOWN).sum()),
        "judged_samples": int(known.sum()),
    }


def soils(cells: CellMeans) -> list[Row]:
    """Right cells per ground class, and confusions; of dirt, flat cells only."""
    rows = []
    for i, zone in enumerate(ZONES):
        here = (cells.true == i) & (cells.estimated != UNKNOWN) & (is_flat(cells.slope) | (i not in DIRT))
        counts = {other.name: int((cells.estimated[here] == k).sum()) for k, other in enumerate(ZONES) if k != i}
        wrong = {name: count for name, count in counts.items() if count}
        right = 100 - _wrong(cells, here)
        rows.append({"name": zone.name, "cells": int(here.sum()), "right_pct": right, "taken_for": wrong})
    return rows


def c_rr_bias(placed: PlacedSamples) -> float:
    """Mean c_rr error on flat ground off borders: what calibration should remove."""
    judged = np.isfinite(placed.c_rr) & is_flat(placed.slope) & (placed.border_m > INTERIOR_M)
    return _finite(np.mean, placed.c_rr_error[judged])


def by_border(cells: CellMeans) -> list[Row]:
    """Wrong cells by distance from the nearest border."""
    known = cells.estimated != UNKNOWN
    return by_border_distance(cells.estimated[known], cells.true[known], cells.border_m[known])


def _wrong(cells: CellMeans, which: Bools | slice = EVERY) -> float:
    """Share [%] of cells in the wrong class."""
    return wrong_percent(cells.estimated[which], cells.true[which])


def _share(flags: Bools) -> float:
    return 100.0 * _finite(np.mean, flags)


def _finite(figure: Callable[[AnyArray], AnyArray], values: AnyArray) -> float:
    """A figure; NaN if empty or infinite (a median with over half infinite)."""
    value = float(figure(values)) if len(values) else math.nan
    return value if math.isfinite(value) else math.nan
