"""What a cell keeps: evidence, not averages (docs/design.md).

Per cell and time bucket only non-negative integers, so that sums commute and the same samples give the same grid, bit
for bit, in any order. A count is metres driven in units of 1/4096 m; counts saturate instead of wrapping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Ints
from protocol.site.geometry import BLOCK_CELLS

SCHEMA = 6  # of everything below; a snapshot of another schema is folded again from the journal

CELLS = BLOCK_CELLS * BLOCK_CELLS  # of a block
WEIGHT_UNITS_PER_M = 4096
COUNT_MAX = np.iinfo(np.uint32).max

# c_rr votes: centres spaced evenly in log(c_rr); 24 bins separate 0.04 from 0.06 by two bins, 8 bins do not
# (docs/how-the-map-comes-about.md).
RESISTANCE_BINS = 24
RESISTANCE_CENTRES = np.geomspace(0.004, 0.4, RESISTANCE_BINS)
# Gradient votes: centres every 1/32 over +-0.5 [m/m].
GRADE_BINS = 33
GRADE_CENTRES = np.linspace(-0.5, 0.5, GRADE_BINS)
SECTORS = 16  # of heading, the first one centred on east

RESISTANCE = slice(0, RESISTANCE_BINS)
GRADE_EAST = slice(RESISTANCE.stop, RESISTANCE.stop + GRADE_BINS)
GRADE_NORTH = slice(GRADE_EAST.stop, GRADE_EAST.stop + GRADE_BINS)
HEADING = slice(GRADE_NORTH.stop, GRADE_NORTH.stop + SECTORS)
# One count: metres of the c_rr votes, times the standard deviation that their samples state as a share of DOUBT_MOST.
DOUBT = HEADING.stop
DOUBT_MOST = 0.032  # larger deviations count as this one [-]: three of it are half of what tells sand from concrete
AIDED = DOUBT + 1  # metres, times the share of their place that came from lanes
COUNTS = AIDED + 1

VISITS, MACHINES = 0, 1  # the two bitmaps
SHARE_ONE = 256  # a vote is split between two neighbouring bins in 1/256


@dataclass(frozen=True)
class Evidence:
    """Evidence of whole blocks, summed over the time buckets that are still valid.

    counts: (blocks, 256, COUNTS) uint64; bitmaps: (blocks, 256, 2) uint64; newest_ns: (blocks, 256), 0 for never.
    changed_ns: (blocks, 256) when the ground changed, so that older evidence is excluded; 0 where it did not.
    """

    counts: NDArray[np.uint64]
    bitmaps: NDArray[np.uint64]
    newest_ns: Ints
    changed_ns: Ints

    @property
    def weight(self) -> NDArray[np.uint64]:
        """Metres of evidence (blocks, 256) in 1/4096 m: every sample votes for one heading with all its weight."""
        return np.asarray(self.counts[..., HEADING].sum(axis=-1), np.uint64)
