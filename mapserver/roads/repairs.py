"""Repairs, and ground that became worse: where the passes over a segment differ from those before.

On a haul road the driven strip is narrower than what a change of cells must be, to be none of position errors. A
segment has all of a pass, so two or three passes tell. What machines have in common is taken from all of them: a new
calibration of one machine is no repair, since passes are of samples that are corrected as is known now, and since two
machines must agree wherever more than one drives.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy.spatial import cKDTree

from mapserver.evidence.timeline import Block
from mapserver.roads.passes import MINUTE_NS, Passes
from mapserver.roads.segments import Segments
from protocol.arrays import Ints
from protocol.site.geometry import BLOCK_CELLS

BEFORE = 2  # passes, at least, that a segment is known by
FEW = 4  # passes before: fewer do not show how much passes differ by
KNOWN_BY = 32  # passes, at most: the newest ones, as ground wears
# Passes in a row that must differ alike, and by how many robust standard deviations of those before. Three with less
# show what two do not where passes are noisy; on drawn repairs they raise what is seen within three from 87 to 92 %.
RULES = ((2, 4.0), (3, 3.0))
LEAST_AFTER = 2
SHARE = 0.25  # of the median before
HALF_WIDTH_M = 3.0  # of the strip that is driven, with the errors of positions; half the distance of two lanes
FLOOR_SHARE, FLOOR = 0.05, 0.001  # of the median, and least standard deviation of passes
FEW_SHARE, FEW_FLOOR = 0.1, 0.003  # the same where few were before: of nearly all segments on development seeds


@dataclass(frozen=True)
class Repair:
    """A change of a segment's ground.

    minute, seen: of the first pass that saw it, and of the one that showed it; before, after: medians of c_rr.
    """

    segment: int
    minute: int
    seen: int
    before: float
    after: float

    @property
    def first_ns(self) -> int:
        """When the first pass that saw it began, to the minute."""
        return self.minute * MINUTE_NS

    @property
    def seen_ns(self) -> int:
        """When it was sure."""
        return (self.seen + 1) * MINUTE_NS


def repairs(passes: Passes) -> tuple[list[Repair], int]:
    """All changes, and how many passes were looked at. After one, a segment is known by later passes alone."""
    out: list[Repair] = []
    bounds = np.flatnonzero(np.diff(passes.segment, prepend=-1, append=-1))
    cuts, looks = _cuts(passes.c_rr, passes.machine, bounds)
    for first, at, sure, end in cuts.tolist():
        before, after = (float(np.median(passes.c_rr[part])) for part in (slice(first, at), slice(at, end)))
        minute, seen = passes.minute[[at, sure]].tolist()
        out.append(Repair(int(passes.segment[at]), minute, seen, before, after))
    return out, looks


@numba.njit(cache=True, nogil=True)
def _cuts(c_rr: Any, machine: Any, bounds: Any) -> tuple[Any, int]:
    """Of each change (n, 4): first pass before it, first after it, the one that showed it, end of all after.

    bounds: where the passes of each segment begin, and the end of all. Also how many passes were looked at.
    """
    cuts, count, looks = np.empty((len(c_rr), 4), np.int64), 0, 0
    for k in range(len(bounds) - 1):
        begin, first_cut = bounds[k], count
        for at in range(bounds[k] + BEFORE, bounds[k + 1] - LEAST_AFTER + 1):
            if at - begin < BEFORE:
                continue
            looks += 1
            end = _sure(c_rr, machine, max(begin, at - KNOWN_BY), at, bounds[k + 1])
            if end:
                cuts[count, 0], cuts[count, 1], cuts[count, 2] = begin, at, end - 1
                count += 1
                begin = at
        for i in range(first_cut, count):
            cuts[i, 3] = cuts[i + 1, 1] if i + 1 < count else bounds[k + 1]
    return cuts[:count], looks


@numba.njit(cache=True, nogil=True)
def _sure(c_rr: Any, machine: Any, begin: int, at: int, end: int) -> int:
    """The end of the passes from `at` on that show a change from those since `begin`; 0 where there is none."""
    for count, sigmas in RULES:
        before, after = slice(begin, at), slice(at, at + count)
        if (
            at + count <= end
            and _differs(c_rr[before], c_rr[after], sigmas)
            and _agree(machine[before], machine[after])
        ):
            return at + count
    return 0


@numba.njit(cache=True, nogil=True)
def _differs(before: Any, after: Any, sigmas: float) -> bool:
    """Whether all passes after differ alike from the median of those before, beyond noise and by enough."""
    median = np.median(before)
    share, floor = (FEW_SHARE, FEW_FLOOR) if len(before) < FEW else (FLOOR_SHARE, FLOOR)
    spread = max(1.4826 * np.median(np.abs(before - median)), share * median, floor)
    least = max(sigmas * spread, SHARE * max(median, FLOOR))
    return bool((after - median > least).all() or (median - after > least).all())


@numba.njit(cache=True, nogil=True)
def _agree(before: Any, after: Any) -> bool:
    """Whether the passes after are of several machines, where several drove before."""
    return bool((after != after[0]).any() or (before == before[0]).all())


def ages(segments: Segments, changes: Iterable[Repair], cell_m: float) -> dict[Block, Ints]:
    """Since when (256,) [ns] the ground of cells is as it is, 0 for ever, in the blocks of segments that changed.

    Of those cells whose centres are nearest to a changed segment, and within HALF_WIDTH_M of its line.
    """
    newest: dict[int, int] = {}
    for change in changes:
        newest[change.segment] = max(change.first_ns, newest.get(change.segment, 0))
    out: dict[Block, Ints] = {}
    if not newest:
        return out
    owner, tree = np.repeat(np.arange(len(segments.ids)), np.diff(segments.ends)), cKDTree(segments.points)
    for segment, begin_ns in newest.items():
        line = segments.line(segment)
        first = np.floor((line.min(axis=0) - HALF_WIDTH_M) / cell_m).astype(np.int64)
        last = np.floor((line.max(axis=0) + HALF_WIDTH_M) / cell_m).astype(np.int64)
        x, y = (grid.ravel() for grid in np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True))))
        off_m, nearest = tree.query((np.stack([x, y], axis=1) + 0.5) * cell_m)
        own = (off_m <= HALF_WIDTH_M) & (owner[nearest] == segment)
        for column, row in zip(x[own].tolist(), y[own].tolist(), strict=True):
            block = out.setdefault((column // BLOCK_CELLS, row // BLOCK_CELLS), np.zeros(BLOCK_CELLS**2, np.int64))
            block[row % BLOCK_CELLS * BLOCK_CELLS + column % BLOCK_CELLS] = begin_ns
    return out
