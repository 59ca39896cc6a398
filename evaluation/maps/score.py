"""How right a map is: the paper's J, the share of known cells whose class differs from the truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evaluation.ground.truth import border_distance
from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import Bools, Floats, Ints
from protocol.queries.answers import Region
from protocol.site.ground_classes import UNKNOWN, resistance_class, slope_class, wrong_percent

BORDER_EDGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # of the bins by distance to the nearest border; the last is open
WAY_STEP_M = 0.1  # between two points of a way that is laid over cells


@dataclass(frozen=True)
class MapScore:
    """Known cells, and the percentage of them that are wrong (NaN where none is known)."""

    cells: int
    wrong_resistance_pct: float
    wrong_grade_pct: float


@dataclass(frozen=True)
class DrivenScore:
    """Cells that a load centre truly passed, which of them the map knows [%], and which of those are wrong [%].

    by_border: the same by distance to the nearest other kind of ground, rows of `by_border_distance`.
    """

    cells: int
    known_pct: float
    wrong_resistance_pct: float
    wrong_grade_pct: float
    by_border: list[dict[str, Any]]


def score(region: Region, truth: NamedLayers) -> MapScore:
    """Compare a map with true layers of the same cells (resistance, grade_east, grade_north)."""
    found = resistance_class(region["resistance"])
    slope = slope_class(region["grade_east"], region["grade_north"])
    return MapScore(
        cells=int(np.isfinite(region["resistance"]).sum()),
        wrong_resistance_pct=wrong_percent(found, resistance_class(truth["resistance"])),
        wrong_grade_pct=wrong_percent(slope, slope_class(truth["grade_east"], truth["grade_north"])),
    )


def score_driven(region: Region, truth: NamedLayers, ways_m: Iterable[Floats]) -> DrivenScore:
    """Compare a map with true layers of the same cells where machines truly were.

    Cells that are known but were never passed, because a position was wrong, do not count. ways_m: true places (n, 2)
    of each machine's load centre, as `ground_truth.read_way` gives them.
    """
    true = resistance_class(truth["resistance"])
    driven = driven_cells(region, ways_m) & (true != UNKNOWN)
    found, true_there = resistance_class(region["resistance"])[driven], true[driven]
    slope = slope_class(region["grade_east"], region["grade_north"])
    true_slope = slope_class(truth["grade_east"], truth["grade_north"])
    return DrivenScore(
        cells=int(driven.sum()),
        known_pct=100.0 * float((found != UNKNOWN).mean()) if driven.any() else np.nan,
        wrong_resistance_pct=wrong_percent(found, true_there),
        wrong_grade_pct=wrong_percent(slope[driven], true_slope[driven]),
        by_border=by_border_distance(found, true_there, border_distance(true, region.cell_m)[driven]),
    )


def driven_cells(region: Region, ways_m: Iterable[Floats]) -> Bools:
    """Which cells (rows, columns) of a region any of the ways (n, 2) passes."""
    passed: Bools = np.zeros((len(region.y_m), len(region.x_m)), np.bool_)
    corner = np.array([region.bounds.west_m, region.bounds.south_m])
    for way_m in ways_m:
        column, row = np.floor((_dense(way_m) - corner) / region.cell_m + 1e-9).astype(int).T
        inside = (row >= 0) & (row < passed.shape[0]) & (column >= 0) & (column < passed.shape[1])
        passed[row[inside], column[inside]] = True
    return passed


def by_border_distance(found: Ints, true: Ints, border_m: Floats) -> list[dict[str, Any]]:
    """Known and wrong cells (k,) by their distance to the nearest border, one row per bin.

    from_m, to_m: the bin, open (None) at the end. cells: with a truth. known_pct: of those. wrong_pct: of known ones.
    """
    found, true, border_m = (values[true != UNKNOWN] for values in (found, true, border_m))
    which = np.digitize(border_m, BORDER_EDGES_M) - 1
    rows = []
    for i, (low, high) in enumerate(zip(BORDER_EDGES_M, (*BORDER_EDGES_M[1:], None), strict=True)):
        here = which == i
        known = 100.0 * float((found[here] != UNKNOWN).mean()) if here.any() else np.nan
        wrong = wrong_percent(found[here], true[here])
        rows.append({"from_m": low, "to_m": high, "cells": int(here.sum()), "known_pct": known, "wrong_pct": wrong})
    return rows


def _dense(way_m: Floats) -> Floats:
    """A way (n, 2) with points at most WAY_STEP_M apart."""
    if len(way_m) < 2:
        return way_m
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way_m, axis=0).T))])
    at = np.linspace(0.0, driven[-1], int(driven[-1] / WAY_STEP_M) + 2)
    return np.stack([np.interp(at, driven, column) for column in way_m.T], axis=-1)
