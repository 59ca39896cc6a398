"""Samples into votes: each sample's metres, to be spread over the cells that its position's covariance covers.

`prepare` does the floating point once, in numpy; the kernels (fold.py) then agree to the bit: they only look up,
multiply and divide integers.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapserver import evidence as ev
from protocol.arrays import Bools, Floats, Ints, Table

VISIT_NS = 60_000_000_000  # one machine's passes within a minute are one visit

# exp(-d2 / 2) in 1/65536 over squared Mahalanobis distance, up to 3 sigma: a table is 3.7 times faster than exp.
TABLE_PER_UNIT = 256
TABLE_MAX_D2 = 9.0
TABLE: Ints = np.rint(65536 * np.exp(-0.5 * np.arange(int(TABLE_MAX_D2 * TABLE_PER_UNIT) + 1) / TABLE_PER_UNIT)).astype(
    np.int64
)


@dataclass(frozen=True)
class FoldConfig:
    """How samples become evidence.

    bucket_s: length of a time bucket. std_floor_m: added to every position's standard deviation, in squares.
    std_cap_m: samples less sure of their place than this are journalled, not folded. kernel: "numba", "numpy", or
    "auto" for numba where it is installed.
    """

    bucket_s: float = 300.0
    std_floor_m: float = 0.3
    std_cap_m: float = 3.0
    kernel: str = "auto"

    def __post_init__(self) -> None:
        if not 60 <= self.bucket_s <= 86_400:
            raise ValueError(f"bucket_s: {self.bucket_s} is not between 60 and 86400")
        # the floor also keeps the covariance invertible: samples are checked in single precision
        if not 0.01 <= self.std_floor_m < self.std_cap_m <= 30:
            raise ValueError("std_floor_m must be at least 0.01 and below std_cap_m, std_cap_m at most 30")
        if self.kernel not in ("auto", "numba", "numpy"):
            raise ValueError(f'kernel: {self.kernel!r} is none of "auto", "numba", "numpy"')


@dataclass(frozen=True)
class Votes:
    """Prepared samples, one entry each, positions in cells.

    place: (n, 2) position; inverse: (n, 3) inverse covariance xx, 2 xy, yy; origin: (n, 2) first column and row of the
    stencil; size: (n,) its edge; weight: (n,); bins, shares: (n, 3) for resistance, grade east, grade north; sector,
    stamp_ns, bucket: (n,); bits: (n, 2) one bit set in each.
    """

    place: Floats
    inverse: Floats
    origin: Ints
    size: Ints
    weight: Ints
    bins: Ints
    shares: Ints
    sector: Ints
    stamp_ns: Ints
    bucket: Ints
    bits: NDArray[np.uint64]


def is_foldable(rows: Table, config: FoldConfig) -> Bools:
    """Which samples know their place well enough to vote: dead reckoning must not become confident poison."""
    xx, xy, yy = (rows[name].astype(np.float64) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    return np.asarray(largest <= config.std_cap_m**2, np.bool_)


def prepare(rows: Table, machine: str, cell_m: float, config: FoldConfig) -> Votes:
    """Turn foldable samples of one machine into votes."""
    place = np.stack([rows["x_m"], rows["y_m"]], axis=1) / cell_m
    floor = config.std_floor_m**2
    xx = (rows["cov_xx_m2"].astype(np.float64) + floor) / cell_m**2
    yy = (rows["cov_yy_m2"].astype(np.float64) + floor) / cell_m**2
    xy = rows["cov_xy_m2"].astype(np.float64) / cell_m**2
    determinant = xx * yy - xy * xy
    reach = np.ceil(2 * np.sqrt(np.maximum(xx, yy))).astype(np.int64)
    pairs = [ev.split_resistance(rows["c_rr"].astype(np.float64))]
    pairs += [ev.split_grade(rows[name].astype(np.float64)) for name in ("grade_e", "grade_n")]
    sector = np.floor(rows["heading_rad"].astype(np.float64) / (2 * np.pi / ev.SECTORS) + 0.5).astype(np.int64)
    return Votes(
        place=place,
        inverse=np.stack([yy, -2 * xy, xx], axis=1) / determinant[:, None],
        origin=np.floor(place).astype(np.int64) - reach[:, None],
        size=2 * reach + 1,
        weight=np.rint(rows["distance_m"].astype(np.float64) * ev.WEIGHT_UNITS_PER_M).astype(np.int64),
        bins=np.stack([lower for lower, _ in pairs], axis=1),
        shares=np.stack([share for _, share in pairs], axis=1),
        sector=sector % ev.SECTORS,
        stamp_ns=rows["stamp_ns"].copy(),
        bucket=rows["stamp_ns"] // round(config.bucket_s * 1e9),
        bits=_bits(rows["stamp_ns"], machine),
    )


def _bits(stamp_ns: Ints, machine: str) -> NDArray[np.uint64]:
    """Bitmaps with the bit of the visit and the bit of the machine (a multiplicative hash takes the top six bits)."""
    name = int.from_bytes(hashlib.blake2b(machine.encode(), digest_size=8).digest(), "little")
    visit = (np.uint64(name) + (stamp_ns // VISIT_NS).astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
    one = np.uint64(1)
    bits = np.empty((len(stamp_ns), 2), np.uint64)
    bits[:, ev.VISITS] = one << (visit >> np.uint64(58))
    bits[:, ev.MACHINES] = one << np.uint64(name >> 58)
    return bits
