"""Samples against the truth at the machine's true places.

Localisation errors do not matter here: a sample's stamp gives the true place. Lag: delay of the estimate after a change
of ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lab.ground.truth import CELL_M, TrueGround
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.site.ground_classes import ZONES, resistance_class, slope_class
from sitegrid.proof.tracks import LoadTrack

C_RR = np.array([zone.c_rr for zone in ZONES])
FLAT_SLOPE = math.tan(math.radians(2.0))
EDGE_M, EDGE_DEG = 2.0, 0.5  # a ramp edge changes the gradient by more than this within this distance
LEAST_RUN_M = 4.0  # shorter zones leave the estimate no time to settle
LEAST_STEP = 0.01  # of c_rr; below it noise decides
BEFORE_M = 2.0  # front wheels cross a border before the load centre: half a wheelbase, 1.5 m, plus a sample
STEP_NS = 10_000_000  # resolution of the border search


@dataclass(frozen=True)
class PlacedSamples:
    """Samples (n,) at true places.

    track: truth at their stamps. zone: ground class. border_m: distance to another. slope: true gradient without
    roughness (n, 2). is_edge: slope changes nearby.
    """

    samples: Table
    track: LoadTrack
    zone: Ints
    border_m: Floats
    slope: Floats
    is_edge: Bools

    @property
    def c_rr(self) -> Floats:
        """Rolling resistance estimates (n,), NaN: none."""
        return np.asarray(self.samples["c_rr"], np.float64)

    @property
    def c_rr_error(self) -> Floats:
        """Estimate minus the zone's value (n,)."""
        return np.asarray(self.c_rr - C_RR[self.zone], np.float64)

    @property
    def normalised_error(self) -> Floats:
        """Error over stated standard deviation (n,)."""
        return self.c_rr_error / np.sqrt(np.asarray(self.samples["c_rr_var"], np.float64))

    @property
    def is_right(self) -> Bools:
        """Whether the class is right (n,)."""
        return np.asarray(resistance_class(self.c_rr) == resistance_class(C_RR[self.zone]), np.bool_)

    @property
    def gradient(self) -> Floats:
        """Estimated gradient (n, 2), east and north."""
        return np.stack([self.samples["grade_e"], self.samples["grade_n"]], axis=-1).astype(float)


@dataclass(frozen=True)
class CellMeans:
    """Classes of one tour's cells (k,): by the mean of samples, and true.

    Means are weighted by distance; UNKNOWN without samples. slope: true gradient of the cell without roughness (k, 2).
    """

    estimated: Ints
    true: Ints
    border_m: Floats
    slope: Floats
    estimated_slope: Ints
    true_slope: Ints


@dataclass(frozen=True)
class Comparison:
    """Estimates against the truth. lags: see `lags`."""

    placed: PlacedSamples
    cells: CellMeans
    lags: Floats


def compare(samples: Table, track: LoadTrack, ground: TrueGround, lag_s: float, from_ns: int) -> Comparison:
    """Compare one drive's samples with the truth from from_ns on; lag_s: by which samples are backdated."""
    placed = place(samples, track, ground, from_ns)
    changes = crossings(track, ground, from_ns)
    return Comparison(placed, cell_means(placed, ground), lags(samples, track, changes, lag_s))


def pool(several: Sequence[Any]) -> Any:
    """Concatenate arrays, or dataclasses of arrays, of several drives."""
    first = several[0]
    if isinstance(first, np.ndarray):
        return np.concatenate(several)
    return type(first)(*(pool([getattr(one, field.name) for one in several]) for field in fields(first)))


def is_flat(slope: Floats) -> Bools:
    """Whether gradients (n, 2) are level (n,)."""
    flat: Bools = np.hypot(*slope.T) < FLAT_SLOPE
    return flat


def place(samples: Table, track: LoadTrack, ground: TrueGround, from_ns: int = 0) -> PlacedSamples:
    """Samples at their true places; those outside the truth's time are dropped."""
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
    """Cell means of samples, and the truth at cell centres."""
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
    """Slope errors (n,) [deg] along the true heading and to its left."""
    true, estimated, ahead_rad = placed.track.gradient, placed.gradient, placed.track.yaw_rad
    left_rad = ahead_rad + np.pi / 2
    ahead, left = (slope_deg(estimated, yaw) - slope_deg(true, yaw) for yaw in (ahead_rad, left_rad))
    return ahead, left


def slope_deg(gradient: Floats, yaw_rad: Floats) -> Floats:
    """Slope (n,) [deg] of gradients (n, 2) along headings (n,)."""
    along = gradient[:, 0] * np.cos(yaw_rad) + gradient[:, 1] * np.sin(yaw_rad)
    return np.asarray(np.degrees(np.arctan(along)), np.float64)


def _edges(track: LoadTrack, ground: TrueGround, driven_m: Floats) -> Bools:
    """Whether the slope changes near track points (n,)."""
    angles = np.degrees(np.arctan(ground.slope(track.place_m)))
    low = np.searchsorted(track.driven_m, driven_m - EDGE_M)
    high = np.searchsorted(track.driven_m, driven_m + EDGE_M, side="right")
    changes = [np.ptp(angles[a:b], axis=0).max(initial=0.0) if b > a else 0.0 for a, b in zip(low, high, strict=True)]
    return np.array(changes) > EDGE_DEG


def _means(values: Floats, weight: Floats, which: Ints, count: int) -> Floats:
    """Weighted means of finite values by group (count,); NaN if empty."""
    known = np.isfinite(values)
    total = np.bincount(which[known], weight[known], count)
    mean: Floats = np.full(count, np.nan)
    np.divide(np.bincount(which[known], (weight * values)[known], count), total, out=mean, where=total > 0)
    return mean


# --- lag -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Crossing:
    """A zone change: stamp, distance so far, c_rr before and after, start of the next."""

    stamp_ns: int
    driven_m: float
    old: float
    new: float
    end_ns: int


def crossings(track: LoadTrack, ground: TrueGround, from_ns: int) -> list[Crossing]:
    """Zone changes under the load centre between lasting zones."""
    fine = track.at(np.arange(max(from_ns, track.stamp_ns[0]), track.stamp_ns[-1] + 1, STEP_NS))
    zone = ground.zone(fine.place_m)
    first = np.concatenate([[0], np.flatnonzero(np.diff(zone)) + 1])
    last = np.concatenate([first[1:] - 1, [len(zone) - 1]])
    run_m = fine.driven_m[last] - fine.driven_m[first]
    changes = []
    for i in range(1, len(first)):
        old, new = (float(C_RR[zone[first[k]]]) for k in (i - 1, i))
        if min(run_m[i - 1], run_m[i]) >= LEAST_RUN_M and abs(new - old) >= LEAST_STEP:
            at = first[i]
            end_ns = int(fine.stamp_ns[last[i]])
            changes.append(Crossing(int(fine.stamp_ns[at]), float(fine.driven_m[at]), old, new, end_ns))
    return changes


def lags(samples: Table, track: LoadTrack, changes: list[Crossing], lag_s: float) -> Floats:
    """Lag per zone change (k, 3): time [s] and distance [m] to detection, and place error [m].

    Samples are backdated by lag_s, the delay with which ground shows; they were known lag_s later. Detection: the
    estimate is closer to the new zone's value; infinite if not before the next change. Place error: what remains after
    backdating, positive beyond the border. Changes whose old value was not reached before are excluded.
    """
    samples = samples[np.isfinite(samples["c_rr"])]
    known = track.at(samples["stamp_ns"] + round(lag_s * 1e9))
    dated_m = track.at(samples["stamp_ns"]).driven_m
    rows = [_lag(samples["c_rr"].astype(float), known, dated_m, crossing) for crossing in changes]
    return np.array([row for row in rows if row], float).reshape(-1, 3)


def _lag(c_rr: Floats, known: LoadTrack, dated_m: Floats, crossing: Crossing) -> tuple[float, float, float] | None:
    nearer = np.abs(c_rr - crossing.new) < np.abs(c_rr - crossing.old)
    early = np.flatnonzero(known.driven_m < crossing.driven_m - BEFORE_M)
    if not len(early) or nearer[early[-1]]:
        return None
    after = early[-1] + 1
    knows = after + np.flatnonzero(nearer[after:] & (known.stamp_ns[after:] <= crossing.end_ns))
    if not len(knows):
        return np.inf, np.inf, np.inf
    i = knows[0]
    lag_s = (known.stamp_ns[i] - crossing.stamp_ns) * 1e-9
    return float(lag_s), float(known.driven_m[i] - crossing.driven_m), float(dated_m[i] - crossing.driven_m)
