"""Map error: the paper's J, the share of known cells in the wrong class; also by distance from the nearest border."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import Bools, Floats, Ints
from protocol.queries.answers import Region
from protocol.site.ground_classes import UNKNOWN, resistance_class, slope_class, wrong_percent
from sitegrid.proof.figures import Row

EDGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # edges of distance bins; the last bin is open
TRACK_STEP_M = 0.1  # point spacing of tracks on the grid


@dataclass(frozen=True)
class MapScore:
    """Known cells, and the percentage in the wrong class (NaN if none is known)."""

    cells: int
    wrong_resistance_pct: float
    wrong_grade_pct: float


@dataclass(frozen=True)
class DrivenScore:
    """Cells truly passed by a load centre, the share known [%], and the share of these in the wrong class [%].

    by_border: see `by_border_distance`.
    """

    cells: int
    known_pct: float
    wrong_resistance_pct: float
    wrong_grade_pct: float
    by_border: list[Row]


def score(region: Region, truth: NamedLayers) -> MapScore:
    """Compare a map with true layers on its cells (resistance, grade_east, grade_north)."""
    (resistance, slope), (true, true_slope) = _classes(region), _classes(truth)
    cells = int((resistance != UNKNOWN).sum())
    return MapScore(cells, wrong_percent(resistance, true), wrong_percent(slope, true_slope))


def score_driven(region: Region, truth: NamedLayers, tracks_m: Iterable[Floats]) -> DrivenScore:
    """Compare a map with true layers where machines truly were.

    Known cells that were never passed, from wrong positions, do not count. tracks_m: true places (n, 2) of each load
    centre, from `sitegrid.proof.tracks.read_load_track`.
    """
    (resistance, slope), (true, true_slope) = _classes(region), _classes(truth)
    driven = driven_cells(region, tracks_m) & (true != UNKNOWN)
    estimated, true_there = resistance[driven], true[driven]
    return DrivenScore(
        cells=int(driven.sum()),
        known_pct=_known_percent(estimated),
        wrong_resistance_pct=wrong_percent(estimated, true_there),
        wrong_grade_pct=wrong_percent(slope[driven], true_slope[driven]),
        by_border=by_border_distance(estimated, true_there, border_distance(true, region.cell_m)[driven]),
    )


def driven_cells(region: Region, tracks_m: Iterable[Floats]) -> Bools:
    """Cells (rows, columns) of a region on any track (n, 2)."""
    passed: Bools = np.zeros((len(region.y_m), len(region.x_m)), np.bool_)
    corner = np.array([region.bounds.west_m, region.bounds.south_m])
    for track_m in tracks_m:
        column, row = np.floor((_dense(track_m) - corner) / region.cell_m + 1e-9).astype(int).T
        inside = (row >= 0) & (row < passed.shape[0]) & (column >= 0) & (column < passed.shape[1])
        passed[row[inside], column[inside]] = True
    return passed


def by_border_distance(estimated: Ints, true: Ints, border_m: Floats) -> list[Row]:
    """Known and wrong cells (k,) by distance from the nearest border, from_m to to_m (None: open).

    cells: with a truth. known_pct: of these. wrong_pct: of the known ones.
    """
    estimated, true, border_m = (values[true != UNKNOWN] for values in (estimated, true, border_m))
    which = np.digitize(border_m, EDGES_M) - 1
    bins = []
    for i, (low, high) in enumerate(zip(EDGES_M, (*EDGES_M[1:], None), strict=True)):
        here = which == i
        wrong = wrong_percent(estimated[here], true[here])
        counts = {"cells": int(here.sum()), "known_pct": _known_percent(estimated[here]), "wrong_pct": wrong}
        bins.append({"from_m": low, "to_m": high, **counts})
    return bins


def border_distance(classes: Ints, cell_m: float) -> Floats:
    """Distance [m] of cell centres (rows, columns) from the nearest cell of another class.

    UNKNOWN borders on nothing; infinite without another class.
    """
    distance = np.full(classes.shape, np.inf)
    for kind in np.unique(classes[classes != UNKNOWN]).tolist():
        others = (classes != kind) & (classes != UNKNOWN)
        if others.any():
            here = classes == kind
            distance[here] = (distance_transform_edt(~others)[here] - 0.5) * cell_m  # to its edge
    return distance


def _classes(layers: Region | NamedLayers) -> tuple[Ints, Ints]:
    return resistance_class(layers["resistance"]), slope_class(layers["grade_east"], layers["grade_north"])


def _known_percent(classes: Ints) -> float:
    return 100.0 * float((classes != UNKNOWN).mean()) if classes.size else np.nan


def _dense(track_m: Floats) -> Floats:
    """A track (n, 2) with points at most TRACK_STEP_M apart."""
    if len(track_m) < 2:
        return track_m
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track_m, axis=0).T))])
    at = np.linspace(0.0, driven[-1], int(driven[-1] / TRACK_STEP_M) + 2)
    return np.stack([np.interp(at, driven, column) for column in track_m.T], axis=-1)
