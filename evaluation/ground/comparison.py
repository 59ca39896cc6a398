"""Samples against the truth, at the places where the machine truly was.

Where localisation put a sample does not matter here: its stamp says where the machine was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from evaluation.ground.lag import C_RR, crossings, lags
from evaluation.ground.truth import CELL_M, LoadTrack, TrueGround
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.site.ground_classes import resistance_class, slope_class

FLAT_SLOPE = math.tan(math.radians(2.0))
EDGE_M, EDGE_DEG = 2.0, 0.5  # at the edge of a ramp the gradient changes by more than this, this far around


@dataclass(frozen=True)
class PlacedSamples:
    """Samples (n,) at the places where the machine truly was.

    track: the truth at their stamps. zone: kind of ground. border_m: distance to another kind. slope: true gradient
    without unevenness (n, 2). is_edge: whether that changes nearby.
    """

    samples: Table
    track: LoadTrack
    zone: Ints
    border_m: Floats
    slope: Floats
    is_edge: Bools

    @property
    def c_rr(self) -> Floats:
        """Estimates of rolling resistance (n,), NaN where there is none."""
        return np.asarray(self.samples["c_rr"], np.float64)

    @property
    def c_rr_error(self) -> Floats:
        """Estimate minus the value of the zone (n,)."""
        return np.asarray(self.c_rr - C_RR[self.zone], np.float64)

    @property
    def normalised_error(self) -> Floats:
        """The error over its stated standard deviation (n,)."""
        return self.c_rr_error / np.sqrt(np.asarray(self.samples["c_rr_var"], np.float64))

    @property
    def is_right(self) -> Bools:
        """Whether the estimate is in the class of the zone (n,)."""
        return np.asarray(resistance_class(self.c_rr) == resistance_class(C_RR[self.zone]), np.bool_)

    @property
    def gradient(self) -> Floats:
        """Estimated gradient (n, 2), east and north."""
        return np.stack([self.samples["grade_e"], self.samples["grade_n"]], axis=-1).astype(float)


@dataclass(frozen=True)
class CellMeans:
    """Classes of the cells (k,) of one tour: by the mean of their samples, and true ones.

    A mean is weighted by the distance that each sample stands for; UNKNOWN where there is none. slope: true gradient
    over the cell without unevenness (k, 2).
    """

    estimated: Ints
    true: Ints
    border_m: Floats
    slope: Floats
    estimated_slope: Ints
    true_slope: Ints


@dataclass(frozen=True)
class Comparison:
    """Estimates against the truth, from which figures are made. lags: see `evaluation.ground.lag.lags`."""

    placed: PlacedSamples
    cells: CellMeans
    lags: Floats


def compare(samples: Table, track: LoadTrack, ground: TrueGround, lag_s: float, from_ns: int) -> Comparison:
    """Compare the samples of one drive with the truth, from an instant on; lag_s: by which samples are dated back."""
    placed = place(samples, track, ground, from_ns)
    changes = crossings(track, ground, from_ns)
    return Comparison(placed, cell_means(placed, ground), lags(samples, track, changes, lag_s))


def pool(several: Sequence[Any]) -> Any:
    """Arrays, or dataclasses of arrays, of several drives one after the other."""
    first = several[0]
    if isinstance(first, np.ndarray):
        return np.concatenate(several)
    return type(first)(*(pool([getattr(one, field.name) for one in several]) for field in fields(first)))


def is_flat(slope: Floats) -> Bools:
    """Whether gradients (n, 2) are those of level ground (n,)."""
    flat: Bools = np.hypot(*slope.T) < FLAT_SLOPE
    return flat


def place(samples: Table, track: LoadTrack, ground: TrueGround, from_ns: int = 0) -> PlacedSamples:
    """Put samples where the machine truly was at their stamps; those beyond the known truth are excluded."""
    covered = (samples["stamp_ns"] >= max(from_ns, track.stamp_ns[0])) & (samples["stamp_ns"] <= track.stamp_ns[-1])
    samples = samples[covered]
    there = track.at(samples["stamp_ns"])
    here = there.place_m
    return PlacedSamples(
        samples=samples,
        track=there,
        zone=ground.zone(here),
        border_m=ground.border_m(here),
        slope=ground.slope(here),
        is_edge=_edges(track, ground, there.driven_m),
    )


def cell_means(placed: PlacedSamples, ground: TrueGround) -> CellMeans:
    """Means of the samples of each cell, and the truth at its centre."""
    cell = np.floor(placed.track.place_m / CELL_M).astype(np.int64)
    unique, which = np.unique(cell, axis=0, return_inverse=True)
    column, row = unique.T
    centre = np.asarray((unique + 0.5) * CELL_M, np.float64)
    weight = np.asarray(placed.samples["distance_m"], np.float64)
    east, north = (_means(values, weight, which, len(unique)) for values in placed.gradient.T)
    survey = ground.surveyed(column, row)
    return CellMeans(
        estimated=resistance_class(_means(placed.c_rr, weight, which, len(unique))),
        true=resistance_class(C_RR[ground.zone(centre)]),
        border_m=ground.border_m(centre),
        slope=ground.slope(centre),
        estimated_slope=slope_class(east, north),
        true_slope=slope_class(survey[:, 0], survey[:, 1]),
    )


def grade_errors(placed: PlacedSamples) -> tuple[Floats, Floats]:
    """Errors (n,) [deg] of the slope along the machine's true heading, and to its left."""
    true, estimated = placed.track.gradient, placed.gradient
    c, s = np.cos(placed.track.yaw_rad), np.sin(placed.track.yaw_rad)
    ahead, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    return _angle_deg(estimated, ahead) - _angle_deg(true, ahead), _angle_deg(estimated, left) - _angle_deg(true, left)


def _edges(track: LoadTrack, ground: TrueGround, driven_m: Floats) -> Bools:
    """Whether the slope changes around the points (n,) of the track."""
    angles = np.degrees(np.arctan(ground.slope(track.place_m)))
    low = np.searchsorted(track.driven_m, driven_m - EDGE_M)
    high = np.searchsorted(track.driven_m, driven_m + EDGE_M, side="right")
    changes = [np.ptp(angles[a:b], axis=0).max(initial=0.0) if b > a else 0.0 for a, b in zip(low, high, strict=True)]
    return np.array(changes) > EDGE_DEG


def _angle_deg(gradient: Floats, direction: Floats) -> Floats:
    angle: Floats = np.degrees(np.arctan((gradient * direction).sum(axis=-1)))
    return angle


def _means(values: Floats, weight: Floats, which: Ints, count: int) -> Floats:
    """Weighted means of groups (count,), of the values that are finite; NaN of none."""
    known = np.isfinite(values)
    total = np.bincount(which[known], weight[known], count)
    mean: Floats = np.full(count, np.nan)
    np.divide(np.bincount(which[known], (weight * values)[known], count), total, out=mean, where=total > 0)
    return mean
