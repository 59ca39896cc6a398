"""Options of the fold, tables for exp and log, hashes of machine names.

Only operations that IEEE 754 defines to the bit (no exp, log, sin), so all computers get the same evidence.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from protocol.arrays import Bools, Floats, Ints, Table
from protocol.units import MINUTE_NS

VISIT_NS = MINUTE_NS  # a machine's passes within a minute are one visit
HASH = 0x9E3779B97F4A7C15  # 2**64 over the golden ratio: products have well-mixed top bits

# exp(-d2 / 2) in 1/65536 by squared Mahalanobis distance to 3 sigma; 3.7 times faster than exp.
TABLE_PER_UNIT = 256
_SIGMAS_2 = 9
TABLE_LAST = _SIGMAS_2 * TABLE_PER_UNIT + 1
TABLE: Ints = np.append(
    np.rint(65536 * np.exp(-0.5 * np.arange(TABLE_LAST) / TABLE_PER_UNIT)).astype(np.int64), np.int64(0)
)

# Lower c_rr of each 1/SHARE_ONE bin; bins are even in log(c_rr).
RESISTANCE_STEPS: Floats = np.geomspace(
    float(ev.RESISTANCE_CENTRES[0]), float(ev.RESISTANCE_CENTRES[-1]), 2 * (ev.RESISTANCE_BINS - 1) * ev.SHARE_ONE + 1
)[1::2].copy()
GRADE_LOW = float(ev.GRADE_CENTRES[0])
GRADE_STEPS = (ev.GRADE_BINS - 1) * ev.SHARE_ONE / float(ev.GRADE_CENTRES[-1] - ev.GRADE_CENTRES[0])

# Floor added to positions' deviations in squares, because errors last for minutes. More would blur roads of two cells.
STD_FLOOR_M = 0.3
WEIGHT_SHIFT = 32  # shares are exact to 2**-32 before rounding down


@dataclass(frozen=True)
class FoldConfig:
    """How samples become evidence.

    bucket_s: divides an hour. keep_buckets, keep_hours, keep_days: newest spans that each cell keeps apart; older ones
    are summed. std_cap_m: samples of less certain position are not folded.
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
        """Length of a bucket [ns]."""
        return round(self.bucket_s * 1e9)


def is_foldable(rows: Table, config: FoldConfig) -> Bools:
    """Samples of certain enough position; dead reckoning must not spoil the map."""
    xx, xy, yy = (rows[name].astype(np.float64) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
    half = (xx - yy) / 2
    largest = (xx + yy) / 2 + np.sqrt(half * half + xy * xy)
    return np.asarray(largest <= config.std_cap_m**2, np.bool_)


def name_hash(machine: str) -> int:
    """64 bits of a name; the top six choose the machine's bit."""
    return int.from_bytes(hashlib.blake2b(machine.encode(), digest_size=8).digest(), "little")
