"""What a cell keeps: evidence, not averages (docs/design.md).

Non-negative integers per cell and bucket: sums commute, so samples in any order give the same grid, bit for bit. Counts
are metres in 1/4096 m, and saturate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.arrays import Ints
from protocol.site.geometry import BLOCK_CELLS

SCHEMA = 6  # number of the format below; other snapshots are folded again

CELLS = BLOCK_CELLS * BLOCK_CELLS  # cells per block
ZERO: Any = np.int64(0)  # where kernels count from: Numba compiles a callee once more for a literal 0
WEIGHT_UNITS_PER_M = 4096
COUNT_MAX = np.iinfo(np.uint32).max

# c_rr bins, even in log(c_rr): 24 separate 0.04 and 0.06 by two, 8 do not (docs/how-the-map-comes-about.md).
RESISTANCE_BINS = 24
RESISTANCE_CENTRES = np.geomspace(0.004, 0.4, RESISTANCE_BINS)
# Gradient bins, every 1/32 over +-0.5 [m/m].
GRADE_BINS = 33
GRADE_CENTRES = np.linspace(-0.5, 0.5, GRADE_BINS)
SECTORS = 16  # headings per turn, the first centred on east

RESISTANCE = slice(0, RESISTANCE_BINS)
GRADE_EAST = slice(RESISTANCE.stop, RESISTANCE.stop + GRADE_BINS)
GRADE_NORTH = slice(GRADE_EAST.stop, GRADE_EAST.stop + GRADE_BINS)
HEADING = slice(GRADE_NORTH.stop, GRADE_NORTH.stop + SECTORS)
# metres of c_rr votes, times stated deviation over DOUBT_MOST
DOUBT = HEADING.stop
DOUBT_MOST = 0.032  # largest deviation that counts [-]: three are half of sand's contrast to concrete
AIDED = DOUBT + 1  # metres, times the position's share from lanes
COUNTS = AIDED + 1

VISITS, MACHINES = 0, 1  # indices of the bitmaps
SHARE_ONE = 256  # a vote is split between two bins in 1/256


@dataclass(frozen=True)
class Evidence:
    """Valid evidence of whole blocks.

    counts: (blocks, 256, COUNTS) uint64; bitmaps: (blocks, 256, 2) uint64; newest_ns, changed_ns: (blocks, 256), 0 for
    none. A change excludes older evidence.
    """

    counts: NDArray[np.uint64]
    bitmaps: NDArray[np.uint64]
    newest_ns: Ints
    changed_ns: Ints

    @property
    def weight(self) -> NDArray[np.uint64]:
        """Metres (blocks, 256) in 1/4096 m, by headings, which get each sample's whole weight."""
        return np.asarray(self.counts[..., HEADING].sum(axis=-1), np.uint64)
