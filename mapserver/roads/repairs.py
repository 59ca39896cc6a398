"""Repairs and damage: where the passes over a segment differ from earlier ones.

A driven strip is too narrow for the detection of changed cells, which must exceed position errors. A segment takes in
whole passes, so two or three are enough, compared with the same machine in the same direction. A new calibration is no
repair: passes come from samples as corrected today, and two machines must agree where several drive.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.spatial import cKDTree

from mapserver.error_model import PLACE_SHARE, PLACE_STD
from mapserver.roads.passes import MINUTE_NS, Passes
from mapserver.roads.repair_facts import Cells, RoadRepair, cells_of, places_of
from mapserver.roads.segments import SegmentTable
from protocol.arrays import Floats, Ints

HALF_WIDTH_M = 3.0  # metres of the driven strip with position errors, half a lane distance


class RepairTuning(NamedTuple):
    """When a change is a repair; a tuple, for kernels.

    least_known, most_known: earlier passes; only the newest count, because ground wears. least_agree, most_agree:
    successive passes that show a change. sigmas, sigmas_each: their deviation, together and each; share: its mean,
    relative. place_std, place_share: prior deviation, worth `prior` passes.
    """

    least_known: int = 6
    most_known: int = 32
    least_agree: int = 2
    most_agree: int = 3
    sigmas: float = 5.0
    sigmas_each: float = 2.0
    share: float = 0.25
    prior: int = 8
    place_std: float = PLACE_STD
    place_share: float = PLACE_SHARE


TUNING = RepairTuning()


@dataclass(frozen=True)
class Repair:
    """A change of a segment's ground.

    known_ns, first_ns: the earliest pass that it rests on, and the first one after it, to the minute. seen_ns: when it
    was proved. before, after: median c_rr.
    """

    segment: int
    known_ns: int
    first_ns: int
    seen_ns: int
    before: float
    after: float


def since(passes: Passes, earlier: Iterable[Repair]) -> Passes:
    """Passes after earlier changes of their segments."""
    begin_ns = np.zeros(int(passes.segment.max(initial=-1)) + 1, np.int64)
    for one in earlier:
        if one.segment < len(begin_ns):
            begin_ns[one.segment] = max(begin_ns[one.segment], one.first_ns)
    later = passes.minute * MINUTE_NS >= begin_ns[passes.segment]
    return Passes(**{name: column[later] for name, column in passes._asdict().items()})


def repairs(passes: Passes, tuning: RepairTuning = TUNING) -> tuple[list[Repair], int]:
    """All changes, and the number of passes examined. After a change, only later passes count."""
    out: list[Repair] = []
    bounds = np.flatnonzero(np.diff(passes.segment, prepend=-1, append=-1))
    cuts, looks = _cuts(passes.c_rr, passes.machine, 2 * passes.machine + passes.direction, bounds, tuning)
    for first, at, sure, end in cuts.tolist():
        before, after = (float(np.median(passes.c_rr[part])) for part in (slice(first, at), slice(at, end)))
        known, minute, seen = passes.minute[[max(first, at - tuning.most_known), at, sure]].tolist()
        stamps = known * MINUTE_NS, minute * MINUTE_NS, (seen + 1) * MINUTE_NS
        out.append(Repair(int(passes.segment[at]), *stamps, before, after))
    return out, looks


@numba.njit(cache=True, nogil=True)
def _cuts(c_rr: Any, machine: Any, group: Any, bounds: Any, tuning: Any) -> tuple[Any, int]:
    """Changes (n, 4): first pass before, first after, the proof, end; and the number of passes examined.

    group: passes with a common error (machine and direction). bounds: first pass of each segment, and the end.
    """
    cuts, count, looks = np.empty((len(c_rr), 4), np.int64), 0, 0
    groups, means = np.empty((2, tuning.most_known), np.int64), np.empty(tuning.most_known)
    for k in range(len(bounds) - 1):
        begin, first_cut = bounds[k], count
        for at in range(bounds[k] + tuning.least_known, bounds[k + 1] - tuning.least_agree + 1):
            if at - begin < tuning.least_known:
                continue
            looks += 1
            first = max(begin, at - tuning.most_known)
            expected = _expected(c_rr[first:at], group[first:at], groups, means, tuning)
            later = slice(at, min(at + tuning.most_agree, bounds[k + 1]))
            for end in _differing(c_rr[later], group[later], expected, groups, means, tuning) + at:
                if _agree(machine[first:at], machine[at:end]):
                    cuts[count, 0], cuts[count, 1], cuts[count, 2] = begin, at, end - 1
                    count += 1
                    begin = at
                    break
        for i in range(first_cut, count):
            cuts[i, 3] = cuts[i + 1, 1] if i + 1 < count else bounds[k + 1]
    return cuts[:count], looks


@numba.njit(cache=True, nogil=True)
def _expected(c_rr: Any, group: Any, groups: Any, means: Any, tuning: Any) -> tuple[int, float, float, float]:
    """Predict later passes from passes (n,): number of groups, level, variance within and between groups.

    Each machine has a bias, and settles from the same side where ground changes. Random effects: pass = level + group +
    noise. Fills groups (numbers, pass counts) and means.
    """
    count, level, within, between = 0, c_rr.mean(), 0.0, 0.0
    for i in range(len(c_rr)):
        k = 0
        while k < count and groups[0, k] != group[i]:
            k += 1
        if k == count:
            groups[0, k], groups[1, k], means[k] = group[i], 0, 0.0
            count += 1
        groups[1, k] += 1
        step = c_rr[i] - means[k]
        means[k] += step / groups[1, k]
        within += step * (c_rr[i] - means[k])
    for k in range(count):
        between += (means[k] - level) ** 2
    prior = tuning.prior
    known = prior * (tuning.place_std**2 + (tuning.place_share * level) ** 2)
    return count, level, (known + within) / (prior + len(c_rr) - count), (known + between) / (prior + count - 1)


@numba.njit(cache=True, nogil=True)
def _differing(c_rr: Any, group: Any, expected: Any, groups: Any, means: Any, tuning: Any) -> Any:
    """Numbers of leading passes that deviate alike, significantly and by enough."""
    count, level, within, between = expected
    out, side, sigmas, share = np.zeros(len(c_rr), np.bool_), 0.0, 0.0, 0.0
    for i in range(len(c_rr)):
        weight, total = 1.0 / between, level / between
        for k in range(count):
            if groups[0, k] == group[i]:
                weight += groups[1, k] / within
                total += groups[1, k] * means[k] / within
        own = total / weight
        side = side or (1.0 if c_rr[i] > own else -1.0)
        off = side * (c_rr[i] - own)
        apart = off / np.sqrt(within + 1.0 / weight)
        if apart < tuning.sigmas_each:
            break
        sigmas, share = sigmas + apart, share + off / max(own, 0.001)  # no ground has less
        passes = i + 1
        out[i] = (
            passes >= tuning.least_agree and sigmas > tuning.sigmas * np.sqrt(passes) and share > tuning.share * passes
        )
    return np.flatnonzero(out) + 1


@numba.njit(cache=True, nogil=True)
def _agree(before: Any, after: Any) -> bool:
    """Several machines after the change, or only one before."""
    return bool((after != after[0]).any() or (before == before[0]).all())


class Strips:
    """Cells of segments: within HALF_WIDTH_M of a segment's line, and nearest to it."""

    def __init__(self, segments: SegmentTable, cell_m: float) -> None:
        self._segments, self._cell_m = segments, cell_m
        self._owner = np.repeat(np.arange(len(segments.ids)), np.diff(segments.ends))
        self._tree = cKDTree(segments.points) if len(segments.ids) else None

    def located(self, changes: Iterable[Repair], stamp_ns: int) -> list[RoadRepair]:
        """Repairs with their cells, decided at a site time [ns]; those of segments without cells are left out."""
        out, cells = [], dict[int, Cells]()
        for one in changes:
            own = cells[one.segment] = cells.get(one.segment) or self._cells(one.segment)
            stamps = one.known_ns, one.first_ns, min(one.seen_ns, stamp_ns)
            if own:
                out.append(
                    RoadRepair(
                        self._segments.ids[one.segment], *stamps, one.before, one.after, self._cell_m, own, stamp_ns
                    )
                )
        return out

    def placed(self, repairs: Iterable[RoadRepair]) -> list[Repair]:
        """Repairs on the segments that have most of their cells; others are left out."""
        out = []
        for one in repairs:
            off_m, nearest = self._nearest(places_of(one.cells))
            counts = np.bincount(self._owner[nearest[off_m <= HALF_WIDTH_M]])
            if len(counts):
                stamps = one.known_ns, one.first_ns, one.seen_ns
                out.append(Repair(int(counts.argmax()), *stamps, one.before, one.after))
        return out

    def _cells(self, segment: int) -> Cells:
        line = self._segments.line(segment)
        first = np.floor((line.min(axis=0) - HALF_WIDTH_M) / self._cell_m).astype(np.int64)
        last = np.floor((line.max(axis=0) + HALF_WIDTH_M) / self._cell_m).astype(np.int64)
        grids = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
        places = np.stack([grid.ravel() for grid in grids], axis=1)
        off_m, nearest = self._nearest(places)
        own = (off_m <= HALF_WIDTH_M) & (self._owner[nearest] == segment)
        return cells_of(*places[own].T)

    def _nearest(self, places: Ints) -> tuple[Floats, Ints]:
        """Distances [m] of cells (n, 2) from the nearest points of lines, and these; none without roads."""
        if self._tree is None:
            return np.empty(0), np.empty(0, np.int64)
        off_m, nearest = self._tree.query((places + 0.5) * self._cell_m)
        return off_m, nearest
