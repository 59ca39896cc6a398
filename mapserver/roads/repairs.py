"""Repairs, and ground that became worse: where the passes over a segment differ from those before.

On a haul road the driven strip is narrower than what a change of cells must be, to be none of position errors. A
segment has all of a pass, so two passes tell. What machines have in common is taken from all of them: a new
calibration of one machine is no repair, since passes are of samples that are corrected as is known now, and since two
machines must agree wherever more than one drives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.roads.passes import Passes
from protocol.arrays import Bools, Floats, Ints

BEFORE = 4  # passes, at least, that a segment is known by
AGREE = 2  # passes in a row that must differ alike
SIGMAS = 4.0  # robust, of the passes before
SHARE = 0.25  # of the median before
FLOOR_SHARE, FLOOR = 0.05, 0.001  # of the median, and least standard deviation of passes


@dataclass(frozen=True)
class Repair:
    """A change of a segment's ground. minute: of the first pass that saw it; before, after: medians of c_rr."""

    segment: int
    minute: int
    seen: int
    before: float
    after: float


def repairs(passes: Passes) -> tuple[list[Repair], int]:
    """All changes, and how many passes were looked at. After one, a segment is known by later passes alone."""
    out: list[Repair] = []
    looks = 0
    bounds = np.flatnonzero(np.diff(passes.segment, prepend=-1, append=-1))
    for first, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        own = slice(first, end)
        changes, looked = _of_segment(passes.c_rr[own], passes.machine[own])
        looks += looked
        for at, seen, begin, stop in changes:
            before, after = passes.c_rr[own][begin:at], passes.c_rr[own][at:stop]
            minute, seen_minute = passes.minute[own][[at, seen]].tolist()
            segment = int(passes.segment[first])
            out.append(Repair(segment, minute, seen_minute, float(np.median(before)), float(np.median(after))))
    return out, looks


def _of_segment(c_rr: Floats, machine: Ints) -> tuple[list[tuple[int, int, int, int]], int]:
    """Of each change the first pass after it, the one that showed it, and first and end of the passes around it."""
    cuts: list[tuple[int, int]] = []
    begin, looks = 0, 0
    for last in range(AGREE - 1, len(c_rr)):
        at = last - AGREE + 1
        if at - begin < BEFORE:
            continue
        looks += 1
        if _differs(c_rr[begin:at], c_rr[at : last + 1]) and _agree(machine[begin:at], machine[at : last + 1]):
            cuts.append((at, last))
            begin = at
    begins = [0, *(at for at, _ in cuts)]
    ends = [*(at for at, _ in cuts[1:]), len(c_rr)]
    return [(at, seen, first, end) for (at, seen), first, end in zip(cuts, begins, ends, strict=False)], looks


def _differs(before: Floats, after: Floats) -> bool:
    """Whether all passes after differ alike from the median of those before, beyond noise and by enough."""
    median = float(np.median(before))
    spread = max(1.4826 * float(np.median(np.abs(before - median))), FLOOR_SHARE * median, FLOOR)
    off = after - median
    beyond: Bools = np.abs(off) > max(SIGMAS * spread, SHARE * max(median, FLOOR))
    return bool(beyond.all()) and bool((off > 0).all() or (off < 0).all())


def _agree(before: Ints, after: Ints) -> bool:
    """Whether the passes after are of several machines, where several drove before."""
    return len(np.unique(after)) > 1 or len(np.unique(before)) == 1
