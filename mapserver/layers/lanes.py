"""Lanes: metres driven by heading, fading with age and later traffic in the same direction.

When a road moves, machines silently drive elsewhere. So in a block passes fade with later metres in about the same
direction, and with age:

    metres = sum of passes (1 - aid_share) exp(-later metres / FADES_M) 2^(-age / FADES_DAYS)

1 - aid_share removes what positions took from lanes, which must not confirm themselves. Slopes of the ground are the
mean of gradient votes, which fade with the passes that gave them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.settling import DAY_S
from mapserver.evidence.timeline import Block, TimedPage, TimedPages
from protocol.arrays import Floats, Ints
from protocol.queries.lanes import SCALE_M, SLOPE_CELLS, SLOPE_STEP, SLOPES, UNKNOWN_SLOPE, LaneTile
from protocol.site.geometry import BLOCK_CELLS

FADES_M = 8 * BLOCK_CELLS * 1.0  # metres, eight passes: fewer know the middle less well, more keep a moved road
FADES_DAYS = 7.0  # half-life of an unused lane [days]
LEAST_M = 0.1  # smaller values [m] are left out
LEAST_SLOPE_M = 1.0  # of passes in a part with a slope: a quarter of one
MOMENTS = np.stack([np.ones(ev.GRADE_BINS), ev.GRADE_CENTRES])  # of gradient votes: their sum, and that of slopes


def lane_tile(block: Block, pages: TimedPages, first: Ints, stamp_ns: int) -> LaneTile | None:
    """Lanes of one block, None if undriven. first: index (256,) of each cell's first valid page."""
    metres, later_m = np.zeros((ev.SECTORS, ev.CELLS)), np.zeros(ev.SECTORS)
    grades = np.zeros((2, 2, ev.CELLS))  # votes, and slopes times votes: east, north
    visits, machines = np.zeros(ev.CELLS, np.uint64), np.uint64(0)
    newest_ns, days = 0, set()
    for index, timed in reversed(list(enumerate(pages))):
        cells = timed.page.cells[first[timed.page.cells["cell"]] <= index]
        if not len(cells):
            continue
        counts, driven = _by_sector(timed, first, index)
        ended_ns = int(cells["newest_ns"].max())
        age = max(stamp_ns - ended_ns, 0) / (DAY_S * 1e9)
        left = driven * np.exp(-later_m / FADES_M)[:, None] * 2 ** (-age / FADES_DAYS)
        metres += left
        kept = left.sum(axis=0) / np.maximum(counts[ev.HEADING].sum(axis=0), 1)
        grades += kept * np.stack([MOMENTS @ counts[part] for part in (ev.GRADE_EAST, ev.GRADE_NORTH)], axis=1)
        along_m = driven.sum(axis=1)
        later_m += along_m + np.roll(along_m, 1) + np.roll(along_m, -1)
        visits[cells["cell"]] |= cells["visits"]
        machines |= np.bitwise_or.reduce(cells["machines"])
        newest_ns = max(newest_ns, ended_ns)
        days.add(ended_ns // (DAY_S * 10**9))
    if not newest_ns:
        return None
    passes = int(np.bitwise_count(visits).max())
    plane = SCALE_M.quantised(np.where(metres < LEAST_M, np.nan, metres))
    return LaneTile(*block, newest_ns, passes, len(days), int(machines.bit_count()), plane, _slopes(grades))


def _by_sector(timed: TimedPage, first: Ints, index: int) -> tuple[Floats, Floats]:
    """Counts of a page, and metres (16, 256) by heading in cells where it is valid, without aided shares."""
    counts = np.zeros((ev.COUNTS, ev.CELLS))
    counts.reshape(-1)[timed.page.votes["place"]] = timed.page.votes["count"]
    metres = counts[ev.HEADING] * ((first <= index) / ev.WEIGHT_UNITS_PER_M)
    own: Floats = np.clip(1 - counts[ev.AIDED] / np.maximum(counts[ev.HEADING].sum(axis=0), 1), 0, 1)
    return counts, metres * own


def _slopes(grades: Floats) -> NDArray[np.int8]:
    """Mean gradient of the parts of a block in steps. grades (2, 2, 256): metres, slopes times metres; east, north."""
    shape = (BLOCK_CELLS // SLOPE_CELLS, SLOPE_CELLS)
    metres, climbs = grades.reshape(2, 2, *shape, *shape).sum(axis=(3, 5)).reshape(2, *SLOPES)
    steps = np.rint(climbs / np.maximum(metres, LEAST_SLOPE_M) / SLOPE_STEP).clip(UNKNOWN_SLOPE + 1, -UNKNOWN_SLOPE - 1)
    return np.where(metres >= LEAST_SLOPE_M, steps, UNKNOWN_SLOPE).astype(np.int8)
