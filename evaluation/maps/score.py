"""How right a map is: the paper's J, the share of known cells whose class differs from the truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from evaluation.maps.borders import BorderBin, border_distance, by_border_distance
from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import Bools, Floats
from protocol.queries.answers import Region
from protocol.site.ground_classes import UNKNOWN, resistance_class, slope_class, wrong_percent

TRACK_STEP_M = 0.1  # between two points of a track that is compared with cells


@dataclass(frozen=True)
class MapScore:
    """Known cells, and the percentage of them that are wrong (NaN where none is known)."""

    cells: int
    wrong_resistance_pct: float
    wrong_grade_pct: float


@dataclass(frozen=True)
class DrivenScore:
    """Cells that a load centre truly passed, which of them the map knows [%], and which of those are wrong [%].

    by_border: the same by distance from the nearest other kind of ground.
    """

    cells: int
    known_pct: float
    wrong_resistance_pct: float
    wrong_grade_pct: float
    by_border: list[BorderBin]


def score(region: Region, truth: NamedLayers) -> MapScore:
    """Compare a map with true layers of the same cells (resistance, grade_east, grade_north)."""
    resistance = resistance_class(region["resistance"])
    slope = slope_class(region["grade_east"], region["grade_north"])
    return MapScore(
        cells=int(np.isfinite(region["resistance"]).sum()),
        wrong_resistance_pct=wrong_percent(resistance, resistance_class(truth["resistance"])),
        wrong_grade_pct=wrong_percent(slope, slope_class(truth["grade_east"], truth["grade_north"])),
    )


def score_driven(region: Region, truth: NamedLayers, tracks_m: Iterable[Floats]) -> DrivenScore:
    """Compare a map with true layers of the same cells where machines truly were.

    Cells that are known but were never passed, because a position was wrong, do not count. tracks_m: true places
    (n, 2) of each machine's load centre, as `evaluation.ground.truth.read_load_track` has them.
    """
    true = resistance_class(truth["resistance"])
    driven = driven_cells(region, tracks_m) & (true != UNKNOWN)
    estimated, true_there = resistance_class(region["resistance"])[driven], true[driven]
    slope = slope_class(region["grade_east"], region["grade_north"])
    true_slope = slope_class(truth["grade_east"], truth["grade_north"])
    return DrivenScore(
        cells=int(driven.sum()),
        known_pct=100.0 * float((estimated != UNKNOWN).mean()) if driven.any() else np.nan,
        wrong_resistance_pct=wrong_percent(estimated, true_there),
        wrong_grade_pct=wrong_percent(slope[driven], true_slope[driven]),
        by_border=by_border_distance(estimated, true_there, border_distance(true, region.cell_m)[driven]),
    )


def driven_cells(region: Region, tracks_m: Iterable[Floats]) -> Bools:
    """Which cells (rows, columns) of a region any of the tracks (n, 2) passes."""
    passed: Bools = np.zeros((len(region.y_m), len(region.x_m)), np.bool_)
    corner = np.array([region.bounds.west_m, region.bounds.south_m])
    for track_m in tracks_m:
        column, row = np.floor((_dense(track_m) - corner) / region.cell_m + 1e-9).astype(int).T
        inside = (row >= 0) & (row < passed.shape[0]) & (column >= 0) & (column < passed.shape[1])
        passed[row[inside], column[inside]] = True
    return passed


def _dense(track_m: Floats) -> Floats:
    """A track (n, 2) with points at most TRACK_STEP_M apart."""
    if len(track_m) < 2:
        return track_m
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track_m, axis=0).T))])
    at = np.linspace(0.0, driven[-1], int(driven[-1] / TRACK_STEP_M) + 2)
    return np.stack([np.interp(at, driven, column) for column in track_m.T], axis=-1)
