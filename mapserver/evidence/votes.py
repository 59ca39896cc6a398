"""Samples into votes: each sample's metres, to be spread over the cells that its position's covariance covers.

All that is not integer happens here, in operations that IEEE 754 rounds in one way only (no exp, log or sin: they come
from tables), so that the kernels of fold.py and fold_numba.py agree to the bit.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from protocol.arrays import Bools, Floats, Ints, Table

VISIT_NS = 60_000_000_000  # one machine's passes within a minute are one visit
HASH = 0x9E3779B97F4A7C15  # 2**64 over the golden ratio: multiplied by it, the top bits of a number are well mixed

# exp(-d2 / 2) in 1/65536 over squared Mahalanobis distance, up to 3 sigma, and 0 beyond: a table is 3.7 times faster
# than exp.
TABLE_PER_UNIT = 256
_SIGMAS_2 = 9
TABLE_LAST = _SIGMAS_2 * TABLE_PER_UNIT + 1
TABLE: Ints = np.append(
    np.rint(65536 * np.exp(-0.5 * np.arange(TABLE_LAST) / TABLE_PER_UNIT)).astype(np.int64), np.int64(0)
)

# Least c_rr of each place on the axis of its bins, in 1/SHARE_ONE of a bin; the axis is even in log(c_rr).
RESISTANCE_STEPS: Floats = np.geomspace(
    float(ev.RESISTANCE_CENTRES[0]), float(ev.RESISTANCE_CENTRES[-1]), 2 * (ev.RESISTANCE_BINS - 1) * ev.SHARE_ONE + 1
)[1::2].copy()
GRADE_LOW = float(ev.GRADE_CENTRES[0])
GRADE_STEPS = (ev.GRADE_BINS - 1) * ev.SHARE_ONE / float(ev.GRADE_CENTRES[-1] - ev.GRADE_CENTRES[0])


@dataclass(frozen=True)
class FoldConfig:
    """How samples become evidence.

    bucket_s: length of a time bucket, a whole part of an hour. keep_buckets, keep_hours, keep_days: so many of the
    newest buckets, hours and days with evidence stay apart in each cell, older ones are summed.
    std_floor_m: added to every position's standard deviation, in squares. std_cap_m: samples less sure of their place
    than this are journalled, not folded. hot_blocks: so many blocks are unpacked at a time, 115 kB each. kernel:
    "numba", "numpy", or "auto" for numba where it is installed.
    """

    bucket_s: float = 300.0
    keep_buckets: int = 6
    keep_hours: int = 4
    keep_days: int = 7
    std_floor_m: float = 0.3
    std_cap_m: float = 3.0
    hot_blocks: int = 128
    kernel: str = "auto"

    def __post_init__(self) -> None:
        if not 60 <= self.bucket_s <= 3600 or 3600 % self.bucket_s:
            raise ValueError(f"bucket_s: {self.bucket_s} is not a whole part of an hour, 60 or more")
        for name in ("keep_buckets", "keep_hours", "keep_days"):
            if not 1 <= getattr(self, name) <= 1000:
                raise ValueError(f"{name}: {getattr(self, name)} is not between 1 and 1000")
        if not 0.01 <= self.std_floor_m < self.std_cap_m <= 30:
            raise ValueError("std_floor_m must be at least 0.01 and below std_cap_m, std_cap_m at most 30")
        if not 1 <= self.hot_blocks <= 100_000:
            raise ValueError(f"hot_blocks: {self.hot_blocks} is not between 1 and 100000")
        if self.kernel not in ("auto", "numba", "numpy"):
            raise ValueError(f'kernel: {self.kernel!r} is none of "auto", "numba", "numpy"')

    @property
    def bucket_ns(self) -> int:
        """Length of a time bucket [ns]."""
        return round(self.bucket_s * 1e9)


@dataclass(frozen=True)
class Votes:
    """Prepared samples, one entry each, positions in cells.

    place: (n, 2) position; inverse: (n, 3) inverse covariance xx, 2 xy, yy; reach: (n,) half the stencil's edge, in
    cells around the one that the sample lies in; weight: (n,); bins, shares: (n, 3) for resistance, grade east, grade
    north; sector, stamp_ns, bucket: (n,); bits: (n, 2) one bit set in each.
    """

    place: Floats
    inverse: Floats
    reach: Ints
    weight: Ints
    bins: Ints
    shares: Ints
    sector: Ints
    stamp_ns: Ints
    bucket: Ints
    bits: NDArray[np.uint64]

    @property
    def middle(self) -> Ints:
        """Column and row (n, 2) of the cell that a sample lies in."""
        return np.floor(self.place).astype(np.int64)


def is_foldable(rows: Table, config: FoldConfig) -> Bools:
    """Which samples know their place well enough to vote: dead reckoning must not become confident poison."""
    xx, xy, yy = (rows[name].astype(np.float64) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    half = (xx - yy) / 2
    largest = (xx + yy) / 2 + np.sqrt(half * half + xy * xy)
    return np.asarray(largest <= config.std_cap_m**2, np.bool_)


def prepare(rows: Table, machine: str, cell_m: float, config: FoldConfig) -> Votes:
    """Turn foldable samples of one machine into votes."""
    place = np.stack([rows["x_m"], rows["y_m"]], axis=1) / cell_m
    floor, per_m2 = config.std_floor_m**2, 1 / (cell_m * cell_m)
    xx = (rows["cov_xx_m2"].astype(np.float64) + floor) * per_m2
    yy = (rows["cov_yy_m2"].astype(np.float64) + floor) * per_m2
    # samples are checked in single precision: what rounding lets pass must not make the covariance indefinite
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
        sector=sector % ev.SECTORS,
        stamp_ns=rows["stamp_ns"].copy(),
        bucket=rows["stamp_ns"] // config.bucket_ns,
        bits=_bits(rows["stamp_ns"], machine),
    )


def split_resistance(c_rr: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the bin above it, linear in log(c_rr); beyond the ends, the end bins."""
    return _split(np.searchsorted(RESISTANCE_STEPS, c_rr, side="right"), np.isnan(c_rr), ev.RESISTANCE_BINS)


def split_grade(grade: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the bin above it; beyond the ends, the end bins."""
    unknown = np.isnan(grade)
    place = np.rint((np.where(unknown, 0.0, grade) - GRADE_LOW) * GRADE_STEPS)
    return _split(np.clip(place, 0, (ev.GRADE_BINS - 1) * ev.SHARE_ONE).astype(np.int64), unknown, ev.GRADE_BINS)


def _split(place: Ints, unknown: Bools, bins: int) -> tuple[Ints, Ints]:
    """Split a place on the axis of bins; what is unknown gives bin -1, which means no vote."""
    lower = np.minimum(place // ev.SHARE_ONE, bins - 2)
    return np.where(unknown, -1, lower), np.where(unknown, 0, place - lower * ev.SHARE_ONE)


def name_hash(machine: str) -> int:
    """64 bits of a machine's name; the top six choose its bit."""
    return int.from_bytes(hashlib.blake2b(machine.encode(), digest_size=8).digest(), "little")


def _bits(stamp_ns: Ints, machine: str) -> NDArray[np.uint64]:
    """Bitmaps with the bit of the visit and the bit of the machine (a multiplicative hash takes the top six bits)."""
    name = np.uint64(name_hash(machine))
    visit = (name + (stamp_ns // VISIT_NS).astype(np.uint64)) * np.uint64(HASH)
    one = np.uint64(1)
    bits = np.empty((len(stamp_ns), 2), np.uint64)
    bits[:, ev.VISITS] = one << (visit >> np.uint64(58))
    bits[:, ev.MACHINES] = one << (name >> np.uint64(58))
    return bits
