"""What a cell keeps: evidence, not averages (DESIGN, "Evidence").

Per cell and time bucket only non-negative integers, so that sums commute and the same samples give the same grid, bit
for bit, in any order. A count is metres driven in units of 1/4096 m; counts saturate instead of wrapping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Floats, Ints

SCHEMA = 1  # of everything below; a snapshot of another schema is folded again from the journal

WEIGHT_UNITS_PER_M = 4096
COUNT_MAX = np.iinfo(np.uint32).max

# c_rr votes: centres spaced evenly in log(c_rr); 24 bins separate 0.04 from 0.06 by two bins (EVIDENCE: 8 bins fail).
RESISTANCE_BINS = 24
RESISTANCE_CENTRES: Floats = np.geomspace(0.004, 0.4, RESISTANCE_BINS)
# Gradient votes: centres every 1/32 over +-0.5 [m/m].
GRADE_BINS = 33
GRADE_CENTRES: Floats = np.linspace(-0.5, 0.5, GRADE_BINS)
SECTORS = 16  # of heading, the first one centred on east

RESISTANCE = slice(0, RESISTANCE_BINS)
GRADE_EAST = slice(RESISTANCE.stop, RESISTANCE.stop + GRADE_BINS)
GRADE_NORTH = slice(GRADE_EAST.stop, GRADE_EAST.stop + GRADE_BINS)
HEADING = slice(GRADE_NORTH.stop, GRADE_NORTH.stop + SECTORS)
WEIGHT = HEADING.stop
COUNTS = WEIGHT + 1

VISITS, MACHINES = 0, 1  # the two bitmaps
SHARE_ONE = 256  # a vote is split between two neighbouring bins in 1/256


@dataclass(frozen=True)
class Evidence:
    """Evidence of whole blocks, summed over time buckets.

    counts: (blocks, 256, COUNTS) uint64; bitmaps: (blocks, 256, 2) uint64; newest_ns: (blocks, 256), 0 for never.
    """

    counts: NDArray[np.uint64]
    bitmaps: NDArray[np.uint64]
    newest_ns: Ints


def split_resistance(c_rr: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the bin above it, linear in log(c_rr); beyond the ends, the end bins."""
    low, high = np.log(RESISTANCE_CENTRES[[0, -1]])
    position = (np.log(np.maximum(c_rr, 1e-9)) - low) / (high - low) * (RESISTANCE_BINS - 1)
    return _split(position, RESISTANCE_BINS)


def split_grade(grade: Floats) -> tuple[Ints, Ints]:
    """Lower bin and share (of SHARE_ONE) of the bin above it; beyond the ends, the end bins."""
    low, high = GRADE_CENTRES[[0, -1]]
    return _split((grade - low) / (high - low) * (GRADE_BINS - 1), GRADE_BINS)


def _split(position: Floats, bins: int) -> tuple[Ints, Ints]:
    """Split a position on the bin axis; NaN gives bin -1, which means no vote."""
    known = ~np.isnan(position)
    fixed = np.zeros(position.shape, np.int64)
    fixed[known] = np.rint(np.clip(position[known], 0, bins - 1) * SHARE_ONE).astype(np.int64)
    lower = np.minimum(fixed // SHARE_ONE, bins - 2)
    share = fixed - lower * SHARE_ONE
    return np.where(known, lower, -1), np.where(known, share, 0)
