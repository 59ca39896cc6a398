"""How well resistance and gradient are estimated: samples at the places where the machine truly was, and figures.

Where localisation put a sample does not matter here: its stamp says where the machine was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from evaluation.ground.lag import C_RR, crossings, lags
from evaluation.ground.truth import CELL_M, Ground, Way
from evaluation.maps.score import by_border_distance
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.site.ground_classes import UNKNOWN, ZONES, resistance_class, slope_class, wrong_percent

INTERIOR_M = 2.0  # the load centre this far from a border has all wheels on one kind of ground
FLAT_SLOPE = math.tan(math.radians(2.0))
EDGE_M, EDGE_DEG = 2.0, 0.5  # at the edge of a ramp the gradient changes by more than this, this far around
DIRT = tuple(i for i, zone in enumerate(ZONES) if "dirt" in zone.name)


@dataclass(frozen=True)
class Placed:
    """Samples (n,) at the places where the machine truly was.

    way: the truth at their stamps. zone: kind of ground. border_m: distance to another kind. slope: true gradient
    without unevenness (n, 2). is_edge: whether that changes nearby.
    """

    samples: Table
    way: Way
    zone: Ints
    border_m: Floats
    slope: Floats
    is_edge: Bools

    @property
    def c_rr(self) -> Floats:
        """Estimates of rolling resistance (n,), NaN where there is none."""
        return np.asarray(self.samples["c_rr"], np.float64)

    @property
    def true_c_rr(self) -> Floats:
        """That of the zone (n,)."""
        return np.asarray(C_RR[self.zone], np.float64)

    @property
    def is_interior(self) -> Bools:
        """Whether all wheels stand on one kind of ground."""
        return self.border_m > INTERIOR_M

    @property
    def gradient(self) -> Floats:
        """Estimated gradient (n, 2), east and north."""
        return np.stack([self.samples["grade_e"], self.samples["grade_n"]], axis=-1).astype(float)


@dataclass(frozen=True)
class Cells:
    """What the samples of one tour say of each cell (k,), and what is true of it.

    Means over a cell's samples are weighted by the way that each stands for; NaN and UNKNOWN where there is none.
    slope: true gradient over the cell without unevenness (k, 2).
    """

    column: Ints
    row: Ints
    found: Ints
    true: Ints
    border_m: Floats
    slope: Floats
    found_slope: Ints
    true_slope: Ints


@dataclass(frozen=True)
class Judged:
    """What figures are made of; of several tours, one after the other, as `pool` does.

    class_right: of samples with an estimate. cell_*: by cells with an estimate. slope_*: by cells with a gradient.
    c_rr_error, c_rr_std, border_m, is_flat: of samples with an estimate. along_deg, across_deg: errors of the gradient
    away from the edges of ramps. edge: of all samples with a gradient. lags: `ground_lag.lags`.
    """

    class_right: Bools
    cell_found: Ints
    cell_true: Ints
    cell_border_m: Floats
    cell_flat: Bools
    slope_found: Ints
    slope_true: Ints
    c_rr_error: Floats
    c_rr_std: Floats
    border_m: Floats
    is_flat: Bools
    along_deg: Floats
    across_deg: Floats
    edge: Bools
    lags: Floats


def judge(samples: Table, way: Way, ground: Ground, lag_s: float, from_ns: int) -> Judged:
    """Compare the samples of one drive with the truth, from an instant on."""
    placed = place(samples, way, ground, from_ns)
    cells = gather(placed, ground)
    known = np.isfinite(placed.c_rr)
    cell = cells.found != UNKNOWN
    sloped = cells.found_slope != UNKNOWN
    measured = np.isfinite(placed.gradient).all(axis=1)
    along, across = grade_errors(placed)
    plain = measured & ~placed.is_edge
    return Judged(
        class_right=(resistance_class(placed.c_rr) == resistance_class(placed.true_c_rr))[known],
        cell_found=cells.found[cell],
        cell_true=cells.true[cell],
        cell_border_m=cells.border_m[cell],
        cell_flat=_is_flat(cells.slope)[cell],
        slope_found=cells.found_slope[sloped],
        slope_true=cells.true_slope[sloped],
        c_rr_error=(placed.c_rr - placed.true_c_rr)[known],
        c_rr_std=np.sqrt(np.asarray(placed.samples["c_rr_var"], np.float64))[known],
        border_m=placed.border_m[known],
        is_flat=_is_flat(placed.slope)[known],
        along_deg=along[plain],
        across_deg=across[plain],
        edge=placed.is_edge[measured],
        lags=lags(samples, way, crossings(way, ground, from_ns), lag_s),
    )


def pool(several: Sequence[Judged]) -> Judged:
    """All of them as one."""
    return Judged(**{f.name: np.concatenate([getattr(one, f.name) for one in several]) for f in fields(Judged)})


def place(samples: Table, way: Way, ground: Ground, from_ns: int = 0) -> Placed:
    """Put samples where the machine truly was at their stamps; those that the truth does not cover are left out."""
    covered = (samples["stamp_ns"] >= max(from_ns, way.stamp_ns[0])) & (samples["stamp_ns"] <= way.stamp_ns[-1])
    samples = samples[covered]
    there = way.at(samples["stamp_ns"])
    here = there.place_m
    return Placed(
        samples=samples,
        way=there,
        zone=ground.zone(here),
        border_m=ground.border_m(here),
        slope=ground.slope(here),
        is_edge=_edges(way, ground, there.driven_m),
    )


def gather(placed: Placed, ground: Ground) -> Cells:
    """Means of the samples of each cell, and the truth at its centre."""
    cell = np.floor(placed.way.place_m / CELL_M).astype(np.int64)
    unique, which = np.unique(cell, axis=0, return_inverse=True)
    column, row = unique.T
    centre = np.asarray((unique + 0.5) * CELL_M, np.float64)
    weight = np.asarray(placed.samples["distance_m"], np.float64)
    east, north = (_means(values, weight, which, len(unique)) for values in placed.gradient.T)
    survey = ground.surveyed(column, row)
    return Cells(
        column=column,
        row=row,
        found=resistance_class(_means(placed.c_rr, weight, which, len(unique))),
        true=resistance_class(C_RR[ground.zone(centre)]),
        border_m=ground.border_m(centre),
        slope=ground.slope(centre),
        found_slope=slope_class(east, north),
        true_slope=slope_class(survey[:, 0], survey[:, 1]),
    )


def grade_errors(placed: Placed) -> tuple[Floats, Floats]:
    """Errors (n,) [deg] of the slope along the machine's true heading, and to its left."""
    true, found = placed.way.gradient, placed.gradient
    c, s = np.cos(placed.way.yaw_rad), np.sin(placed.way.yaw_rad)
    ahead, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    return _angle_deg(found, ahead) - _angle_deg(true, ahead), _angle_deg(found, left) - _angle_deg(true, left)


def figures(judged: Judged) -> dict[str, Any]:
    """The figures of a row; NaN where nothing was to be judged."""
    interior, inside = judged.cell_border_m > INTERIOR_M, judged.border_m > INTERIOR_M
    normalised = judged.c_rr_error / judged.c_rr_std
    lag_s, lag_m, off_m = (_median(column) for column in judged.lags.T)
    dirt = np.isin(judged.cell_true, DIRT) & judged.cell_flat
    deep = dirt & interior
    return {
        "right_class_pct": _share(judged.class_right),
        "wrong_cells_pct": wrong_percent(judged.cell_found, judged.cell_true),
        "wrong_cells_interior_pct": wrong_percent(judged.cell_found[interior], judged.cell_true[interior]),
        "dirt_flat_right_pct": 100 - wrong_percent(judged.cell_found[dirt], judged.cell_true[dirt]),
        "dirt_flat_interior_right_pct": 100 - wrong_percent(judged.cell_found[deep], judged.cell_true[deep]),
        "lag_s": lag_s,
        "lag_m": lag_m,
        "place_off_m": off_m,
        "changes": len(judged.lags),
        "grade_bias_deg": _mean(judged.along_deg),
        "grade_std_deg": _std(judged.along_deg),
        "across_bias_deg": _mean(judged.across_deg),
        "across_std_deg": _std(judged.across_deg),
        "grade_left_out_pct": _share(judged.edge),
        "wrong_slope_cells_pct": wrong_percent(judged.slope_found, judged.slope_true),
        "normalised_error": _rms(normalised[inside]),
        "normalised_error_all": _rms(normalised),
        "cells": len(judged.cell_found),
        "judged_samples": len(judged.class_right),
    }


def soils(judged: Judged) -> list[dict[str, Any]]:
    """How many cells of each kind of ground are right; of dirt, those on flat ground alone."""
    found = []
    for i, zone in enumerate(ZONES):
        here = (judged.cell_true == i) & (judged.cell_flat | (i not in DIRT))
        right = 100 - wrong_percent(judged.cell_found[here], judged.cell_true[here])
        taken = {ZONES[k].name: int((judged.cell_found[here] == k).sum()) for k in range(len(ZONES)) if k != i}
        wrong = {name: count for name, count in taken.items() if count}
        found.append({"name": zone.name, "cells": int(here.sum()), "right_pct": right, "taken_for": wrong})
    return found


def c_rr_bias(judged: Judged) -> float:
    """Mean error of c_rr on flat ground away from borders: what calibration should have removed."""
    return _mean(judged.c_rr_error[judged.is_flat & (judged.border_m > INTERIOR_M)])


def by_border(judged: Judged) -> list[dict[str, Any]]:
    """Wrong cells by distance to the nearest border."""
    return by_border_distance(judged.cell_found, judged.cell_true, judged.cell_border_m)


def _edges(way: Way, ground: Ground, driven_m: Floats) -> Bools:
    """Whether the slope changes around the points (n,) of the way."""
    angles = np.degrees(np.arctan(ground.slope(way.place_m)))
    low = np.searchsorted(way.driven_m, driven_m - EDGE_M)
    high = np.searchsorted(way.driven_m, driven_m + EDGE_M, side="right")
    changes = [np.ptp(angles[a:b], axis=0).max(initial=0.0) if b > a else 0.0 for a, b in zip(low, high, strict=True)]
    return np.array(changes) > EDGE_DEG


def _angle_deg(gradient: Floats, direction: Floats) -> Floats:
    angle: Floats = np.degrees(np.arctan((gradient * direction).sum(axis=-1)))
    return angle


def _is_flat(slope: Floats) -> Bools:
    flat: Bools = np.hypot(*slope.T) < FLAT_SLOPE
    return flat


def _means(values: Floats, weight: Floats, which: Ints, count: int) -> Floats:
    """Weighted means of groups (count,), of the values that are finite; NaN of none."""
    known = np.isfinite(values)
    total = np.bincount(which[known], weight[known], count)
    mean: Floats = np.full(count, np.nan)
    np.divide(np.bincount(which[known], (weight * values)[known], count), total, out=mean, where=total > 0)
    return mean


def _share(flags: Bools) -> float:
    return 100.0 * float(flags.mean()) if len(flags) else math.nan


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan


def _std(values: Floats) -> float:
    return float(values.std()) if len(values) else math.nan


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else math.nan


def _median(values: Floats) -> float:
    """The median; NaN of nothing, or where more than half are infinite."""
    middle = float(np.median(values)) if len(values) else math.nan
    return middle if math.isfinite(middle) else math.nan
