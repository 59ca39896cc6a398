"""The ledger of segments: traffic and ground by hour and direction, summed from a tally.

It also keeps sums by slice: machines measure parts of a segment, and its mean c_rr is over places, not measurements. A
place belongs to the segment nearest in position and axis together (`Placing`), which separates crossing and parallel
roads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.spatial import cKDTree

from mapserver.evidence.fold_config import HASH
from mapserver.roads.segments import SegmentTable
from mapserver.roads.tally import CELL_M, PER_C, PER_M, SUMS, between, corner_m, heading_rad, place, slot
from protocol.arrays import AnyArray, Bools, Floats, Ints, Table

DIRECTIONS = 2
PLACED = SUMS[:-2]  # all but the position in the cell
KEYS = ("segment", "slot", "direction")
LEDGER = np.dtype([*((name, "<i8") for name in (*KEYS, *PLACED)), ("machines", "<u8")])
REACH_M = 8.0  # metres from a road's line that count as on it
TURN_M = 6.0  # metres that a right angle between axes counts as
SLICE_M = 5.0  # approximate [m]: below the length of bad patches, and several passes leave samples in one


@dataclass(frozen=True)
class Ledger:
    """Traffic of segments.

    rows: of LEDGER, by segment, slot, direction. slices: (PLACED, s, 2) sums; ends: (k + 1,) first slice of each
    segment. placed: share of all metres on segments.
    """

    rows: Table
    slices: Ints
    ends: Ints
    slot_ns: int
    placed: float

    def of_slices(self, name: str) -> Ints:
        """One sum (s, 2)."""
        sums: Ints = self.slices[PLACED.index(name)]
        return sums

    def totals(self) -> Table:
        """Sums (k, 2) of segments by direction."""
        out = np.zeros((len(self.ends) - 1) * DIRECTIONS, LEDGER)
        at = self.rows["segment"] * DIRECTIONS + self.rows["direction"]
        for name in PLACED:
            np.add.at(out[name], at, self.rows[name])
        np.bitwise_or.at(out["machines"], at, self.rows["machines"])
        return out.reshape(-1, DIRECTIONS)


class Ledgers:
    """Makes ledgers of the same segments, places assigned alike. slices, place: as in `Placing`."""

    def __init__(self, segments: SegmentTable) -> None:
        self.segments = segments
        placing = Placing(segments)
        self.slices, self.place = placing.slices, placing.place

    def ledger(
        self, tally: Table, slot_ns: int, from_ns: int = 0, to_ns: int = 2**62, cell_m: float = CELL_M
    ) -> Ledger:
        """Sum rows of TALLY, sorted by key, of slots that begin in from_ns <= time < to_ns."""
        tally = between(tally, -(-from_ns // slot_ns), -(-to_ns // slot_ns))
        which, placed = self._placed(tally, cell_m)
        out: Table = np.empty(len(tally), LEDGER)  # few rows are ever touched
        slices = np.zeros((int(self.slices[-1]), DIRECTIONS, len(PLACED)), np.int64)
        used, metres = _sum_up(tally, which, *placed, len(self.segments.ids), slices, out)
        rows = out[np.argsort(out["segment"][:used], kind="stable")]  # so far by slot, segment and direction
        share = int(rows["metres"].sum()) / metres if metres else 1.0
        return Ledger(rows, np.ascontiguousarray(np.moveaxis(slices, 2, 0)), self.slices, slot_ns, share)

    def placed(self, tally: Table, cell_m: float) -> Placed:
        """Assign rows of TALLY; those of one cell and sector lie at their mean place."""
        which, placed = self._placed(tally, cell_m)
        return Placed(*(part[which] for part in placed))

    def _placed(self, tally: Table, cell_m: float) -> tuple[Ints, Placed]:
        """Index (n,) of each row's cell and sector, and where these lie."""
        which, numbers = _places(tally)
        order = np.argsort(numbers)
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        which, numbers, sums = rank[which], numbers[order], np.zeros((len(order), 3), np.int64)
        _sum_places(tally, which, sums)
        inside_m = sums[:, 1:] / (np.maximum(sums[:, :1], 1) * float(PER_M))
        return which, self.place(corner_m(numbers, cell_m) + inside_m, heading_rad(numbers))


@numba.njit(cache=True, nogil=True)
def _places(tally: Any) -> tuple[Any, Any]:
    """Index (n,) of each row's cell and sector, and the numbers (u,) of these as they come.

    A hash table, because a day's rows cover few places, unsorted.
    """
    capacity, used = 1 << 12, 0
    table = np.full(2 * capacity, -1, np.int64)
    numbers, which = np.empty(capacity, np.int64), np.empty(len(tally), np.int64)
    for i in range(len(tally)):
        number = place(tally[i].key)
        at = _slot_of(table, numbers, number)
        if table[at] < 0:
            if used == capacity:
                capacity *= 2
                numbers = np.concatenate((numbers, numbers))
                table = np.full(2 * capacity, -1, np.int64)
                for old in range(used):
                    table[_slot_of(table, numbers, numbers[old])] = old
                at = _slot_of(table, numbers, number)
            table[at], numbers[used] = used, number
            used += 1
        which[i] = table[at]
    return which, numbers[:used]


@numba.njit(cache=True, nogil=True)
def _sum_places(tally: Any, which: Any, sums: Any) -> None:
    """Add metres, x and y of rows to those (u, 3) of their places."""
    for i in range(len(tally)):
        row, at = tally[i], which[i]
        sums[at, 0] += row.metres
        sums[at, 1] += row.x
        sums[at, 2] += row.y


@numba.njit(cache=True, nogil=True)
def _slot_of(table: Any, numbers: Any, number: int) -> Any:
    """Index where a number stands or belongs."""
    last = len(table) - 1
    at = np.int64((np.uint64(number) * np.uint64(HASH)) >> np.uint64(32)) & last
    while table[at] >= 0 and numbers[table[at]] != number:
        at = (at + 1) & last
    return at


@numba.njit(cache=True, nogil=True)
def _sum_up(
    tally: Any, which: Any, segment: Any, inner: Any, direction: Any, segments: int, slices: Any, out: Any
) -> tuple[int, int]:
    """Sum rows by slice, and by slot, segment and direction; returns the row count and all metres.

    which (n,): place of each row. segment, inner, direction (u,): of places. slices (s, 2, PLACED).
    """
    used, metres, begin = 0, 0, 0
    last: Any = np.full(segments * DIRECTIONS, -1, np.int64)  # row of each segment and direction in this slot
    while begin < len(tally):
        now, first, end = slot(tally[begin].key), used, begin
        while end < len(tally) and slot(tally[end].key) == now:
            own = segment[which[end]]
            if own >= 0:
                last[own * DIRECTIONS + direction[which[end]]] = 0
            end += 1
        for code in range(len(last)):
            if last[code] == 0:
                row, last[code] = out[used], used
                row.segment, row.slot, row.direction = code // DIRECTIONS, now, code % DIRECTIONS
                row.metres = row.weighed = row.measured = row.graded = row.kg = row.c = row.c2 = 0
                row.east = row.north = row.fuelled = row.fuel = row.ms = row.v2 = 0
                row.machines = np.uint64(0)
                used += 1
        for i in range(begin, end):
            row, at = tally[i], which[i]
            metres += row.metres
            if segment[at] < 0:
                continue
            _add(row, out[last[segment[at] * DIRECTIONS + direction[at]]], slices[inner[at], direction[at]])
        for i in range(first, used):
            last[out[i].segment * DIRECTIONS + out[i].direction] = -1
        begin = end
    return used, metres


@numba.njit(cache=True, nogil=True)
def _add(row: Any, total: Any, of_slice: Any) -> None:
    """of_slice: in PLACED's order."""
    total.metres += row.metres
    total.weighed += row.weighed
    total.measured += row.measured
    total.graded += row.graded
    total.kg += row.kg
    total.c += row.c
    total.c2 += row.c2
    total.east += row.east
    total.north += row.north
    total.fuelled += row.fuelled
    total.fuel += row.fuel
    total.ms += row.ms
    total.v2 += row.v2
    total.machines |= row.machines
    of_slice[0] += row.metres
    of_slice[1] += row.weighed
    of_slice[2] += row.measured
    of_slice[3] += row.graded
    of_slice[4] += row.kg
    of_slice[5] += row.c
    of_slice[6] += row.c2
    of_slice[7] += row.east
    of_slice[8] += row.north
    of_slice[9] += row.fuelled
    of_slice[10] += row.fuel
    of_slice[11] += row.ms
    of_slice[12] += row.v2


def resistance(ledger: Ledger) -> Floats:
    """c_rr (s,) of slices; gaps interpolated, NaN where a segment has no value."""
    known = ledger.of_slices("measured").sum(axis=1)
    c = np.where(known > 0, ledger.of_slices("c").sum(axis=1) / np.maximum(known, 1) / PER_C, np.nan)
    return filled(c, ledger.ends)


def filled(values: Floats, ends: Ints) -> Floats:
    """Interpolate gaps within each segment, and extend its ends."""
    out = values.copy()
    missing = np.isnan(values)
    owner = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    for segment in np.unique(owner[missing]).tolist():
        part = slice(ends[segment], ends[segment + 1])
        known = np.flatnonzero(~missing[part])
        if len(known):
            out[part] = np.interp(np.arange(part.stop - part.start), known, values[part][known])
    return out


def mean(values: AnyArray, ends: Ints) -> Floats:
    """Mean (k,) over each segment's slices; NaN where any is."""
    if not len(values):
        return np.zeros(0)
    return np.asarray(np.add.reduceat(values, ends[:-1]) / np.diff(ends), np.float64)


class Placed(NamedTuple):
    """Segments of places, all (n,). segment: -1 off road; direction: 0 ahead, 1 back."""

    segment: Ints
    slice: Ints
    direction: Ints


class Placing:
    """Assigns places to segments. slices: (k + 1,) first slice of each segment."""

    def __init__(self, segments: SegmentTable) -> None:
        counts = np.maximum(1, np.rint(segments.length_m / SLICE_M)).astype(np.int64)
        self.slices: Ints = np.concatenate([[0], np.cumsum(counts)])
        owner = np.repeat(np.arange(len(segments.ids)), np.diff(segments.ends))
        same: Bools = owner[1:] == owner[:-1]
        begin, run = segments.points[:-1][same], np.diff(segments.points, axis=0)[same]
        self._owner = owner[1:][same]
        self._tangent = np.arctan2(run[:, 1], run[:, 0])
        along = np.cumsum(np.hypot(*run.T)) - np.hypot(*run.T) / 2
        first = np.searchsorted(self._owner, np.arange(len(segments.ids)))
        begins = along[first] - np.hypot(*run[first].T) / 2 if len(first) else along
        share = (along - begins[self._owner]) / segments.length_m[self._owner]
        inner = np.minimum((share * counts[self._owner]).astype(np.int64), counts[self._owner] - 1)
        self._slice = self.slices[self._owner] + inner
        points = _embedded(begin + run / 2, self._tangent)
        self._tree = cKDTree(points) if len(points) else None

    def place(self, places_m: Floats, heading_rad: Floats) -> Placed:
        """Nearest segments of places (n, 2) with directions of travel (n,) [rad]."""
        if self._tree is None or not len(places_m):
            nothing = np.zeros(len(places_m), np.int64)
            return Placed(nothing - 1, nothing - 1, nothing)
        distance, at = self._tree.query(
            _embedded(places_m, heading_rad), distance_upper_bound=float(np.hypot(REACH_M, TURN_M))
        )
        known = np.isfinite(distance)
        at = np.where(known, at, 0)
        back = np.cos(heading_rad - self._tangent[at]) < 0
        return Placed(np.where(known, self._owner[at], -1), np.where(known, self._slice[at], -1), back.astype(np.int64))


def _embedded(places_m: Floats, heading_rad: Floats) -> Floats:
    """Position and axis as points (n, 4); a right angle is TURN_M."""
    axis = np.stack([np.cos(2 * heading_rad), np.sin(2 * heading_rad)], axis=1)
    return np.asarray(np.concatenate([places_m, TURN_M / 2 * axis], axis=1), np.float64)
