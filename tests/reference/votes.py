"""Samples to votes in numpy; shares only the tables of fold_config.py with the map server's kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import (
    GRADE_LOW,
    GRADE_STEPS,
    HASH,
    RESISTANCE_STEPS,
    STD_FLOOR_M,
    VISIT_NS,
    FoldConfig,
    name_hash,
)
from protocol.arrays import Bools, Floats, Ints, Table


@dataclass(frozen=True)
class Votes:
    """Prepared samples, positions in cells.

    place: (n, 2); inverse: (n, 3) inverse covariance xx, 2 xy, yy; reach: (n,) half the stencil's edge around the
    sample's cell; weight: (n,); bins, shares: (n, 3) for resistance, grade east, grade north; doubt (n,) in 1/256 of
    DOUBT_MOST; aided (n,) in 1/256; sector, stamp_ns, bucket: (n,); bits: (n, 2), one bit set each.
    """

    place: Floats
    inverse: Floats
    reach: Ints
    weight: Ints
    bins: Ints
    shares: Ints
    doubt: Ints
    aided: Ints
    sector: Ints
    stamp_ns: Ints
    bucket: Ints
    bits: NDArray[np.uint64]


def prepare(rows: Table, machine: str, cell_m: float, config: FoldConfig) -> Votes:
    """Votes of one machine's foldable samples."""
    place = np.stack([rows["x_m"], rows["y_m"]], axis=1) / cell_m
    floor, per_m2 = STD_FLOOR_M**2, 1 / (cell_m * cell_m)
    xx = (rows["cov_xx_m2"].astype(np.float64) + floor) * per_m2
    yy = (rows["cov_yy_m2"].astype(np.float64) + floor) * per_m2
    # samples are checked in single precision; rounding must not make the covariance indefinite
    most = np.sqrt(rows["cov_xx_m2"].astype(np.float64) * rows["cov_yy_m2"].astype(np.float64))
    xy = np.clip(rows["cov_xy_m2"].astype(np.float64), -most, most) * per_m2
    scale = 1 / (xx * yy - xy * xy)
    pairs = [split_resistance(rows["c_rr"].astype(np.float64))]
    pairs += [split_grade(rows[name].astype(np.float64)) for name in ("grade_e", "grade_n")]
    sector = np.floor(rows["heading_rad"].astype(np.float64) / (2 * np.pi / ev.SECTORS) + 0.5).astype(np.int64)
    return Votes(
        place=place,
        inverse=np.stack([yy, -2 * xy, xx], axis=1) * scale[:, None],
        reach=np.ceil(2 * np.sqrt(np.maximum(xx, yy))).astype(np.int64),
        weight=np.rint(rows["distance_m"].astype(np.float64) * ev.WEIGHT_UNITS_PER_M).astype(np.int64),
        bins=np.stack([lower for lower, _ in pairs], axis=1),
        shares=np.stack([share for _, share in pairs], axis=1),
        doubt=_doubt(rows["c_rr_var"].astype(np.float64)),
        aided=np.ceil(rows["aid_share"].astype(np.float64) * ev.SHARE_ONE).astype(np.int64),
        sector=sector % ev.SECTORS,
        stamp_ns=rows["stamp_ns"].copy(),
        bucket=rows["stamp_ns"] // config.bucket_ns,
        bits=_bits(rows["stamp_ns"], machine),
    )


def _doubt(variance: Floats) -> Ints:
    std = np.sqrt(np.fmin(variance, ev.DOUBT_MOST**2))  # fmin: unstated doubt is the largest
    return np.ceil(std * (ev.SHARE_ONE / ev.DOUBT_MOST)).astype(np.int64)


def split_resistance(c_rr: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the next, linear in log(c_rr), clipped."""
    return _split(np.searchsorted(RESISTANCE_STEPS, c_rr, side="right"), np.isnan(c_rr), ev.RESISTANCE_BINS)


def split_grade(grade: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the next, clipped."""
    unknown = np.isnan(grade)
    place = np.rint((np.where(unknown, 0.0, grade) - GRADE_LOW) * GRADE_STEPS)
    return _split(np.clip(place, 0, (ev.GRADE_BINS - 1) * ev.SHARE_ONE).astype(np.int64), unknown, ev.GRADE_BINS)


def _split(place: Ints, unknown: Bools, bins: int) -> tuple[Ints, Ints]:
    """Split a place on the bin axis; unknown: bin -1, no vote."""
    lower = np.minimum(place // ev.SHARE_ONE, bins - 2)
    return np.where(unknown, -1, lower), np.where(unknown, 0, place - lower * ev.SHARE_ONE)


def _bits(stamp_ns: Ints, machine: str) -> NDArray[np.uint64]:
    """Bitmaps of visit and machine (multiplicative hash, top six bits)."""
    name = np.uint64(name_hash(machine))
    visit = (name + (stamp_ns // VISIT_NS).astype(np.uint64)) * np.uint64(HASH)
    one = np.uint64(1)
    bits = np.empty((len(stamp_ns), 2), np.uint64)
    bits[:, ev.VISITS] = one << (visit >> np.uint64(58))
    bits[:, ev.MACHINES] = one << (name >> np.uint64(58))
    return bits
