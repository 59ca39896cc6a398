"""What the fold depends on: its options, the tables that replace exp and log, and hashes of machines' names.

The fold uses only operations that IEEE 754 rounds in one way (no exp, log or sin: they come from these tables), so that
every machine computes the same evidence, bit for bit.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.units import MINUTE_NS

VISIT_NS = MINUTE_NS  # one machine's passes within a minute are one visit
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

# Added to every position's standard deviation, in squares: positions that are wrong by the same amount for minutes know
# less than their covariance says. More of it would blur roads that are two cells wide.
STD_FLOOR_M = 0.3
WEIGHT_SHIFT = 32  # shares of a weight are exact to 2**-32 before they are rounded down


@dataclass(frozen=True)
class FoldConfig:
    """How samples become evidence.

    bucket_s: length of a time bucket, a whole part of an hour. keep_buckets, keep_hours, keep_days: so many of the
    newest buckets, hours and days with evidence stay apart in each cell, older ones are summed.
    std_cap_m: samples with a larger standard deviation of position are journalled, not folded.
    """

    bucket_s: float = 300.0
    keep_buckets: int = 6
    keep_hours: int = 4
    keep_days: int = 7
    std_cap_m: float = 3.0

    def __post_init__(self) -> None:
        if not 60 <= self.bucket_s <= 3600 or 3600 % self.bucket_s:
            raise ValueError(f"bucket_s: {self.bucket_s} is not a whole part of an hour, 60 or more")
        for name in ("keep_buckets", "keep_hours", "keep_days"):
            if not 1 <= getattr(self, name) <= 1000:
                raise ValueError(f"{name}: {getattr(self, name)} is not between 1 and 1000")
        if not STD_FLOOR_M < self.std_cap_m <= 30:
            raise ValueError(f"std_cap_m: {self.std_cap_m} is not between {STD_FLOOR_M} and 30")

    @property
    def bucket_ns(self) -> int:
        """Length of a time bucket [ns]."""
        return round(self.bucket_s * 1e9)


def is_foldable(rows: Table, config: FoldConfig) -> Bools:
    """Which samples have a position that is certain enough to vote: long dead reckoning must not spoil the map."""
    xx, xy, yy = (rows[name].astype(np.float64) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    half = (xx - yy) / 2
    largest = (xx + yy) / 2 + np.sqrt(half * half + xy * xy)
    return np.asarray(largest <= config.std_cap_m**2, np.bool_)


def name_hash(machine: str) -> int:
    """64 bits of a machine's name; the top six choose its bit."""
    return int.from_bytes(hashlib.blake2b(machine.encode(), digest_size=8).digest(), "little")
