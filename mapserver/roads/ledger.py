"""The ledger of segments: what drove on each, by hour and direction, and what the ground was like there.

A tally is summed up for the segments that there are now. Beside the rows of the ledger it has the same sums slice by
slice: machines measure c_rr on parts of a segment only, and its mean is over places, not over what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.roads.placing import Placed, Placing
from mapserver.roads.segments import Segments
from mapserver.roads.tally import CELL_M, PER_C, PER_M, SUMS, corner_m, heading_rad, place, slot
from protocol.arrays import AnyArray, Floats, Ints, Table

DIRECTIONS = 2
PLACED = SUMS[:-2]  # those that are no place in a cell
KEYS = ("segment", "slot", "direction")
LEDGER = np.dtype([*((name, "<i8") for name in (*KEYS, *PLACED)), ("machines", "<u8")])


@dataclass(frozen=True)
class Ledger:
    """What drove on segments in some time.

    rows: of LEDGER, by segment, slot and direction. slices: sums of PLACED (names in PLACED's order, s, 2) by slice and
    direction; ends: (k + 1,) first slice of each segment. slot_ns: length of a slot. placed: share of all metres that
    lie on a segment.
    """

    rows: Table
    slices: Ints
    ends: Ints
    slot_ns: int
    placed: float

    def of_slices(self, name: str) -> Ints:
        """One sum of slices (s, 2)."""
        sums: Ints = self.slices[PLACED.index(name)]
        return sums

    def totals(self) -> Table:
        """Sums of each segment and direction, (k, 2) of LEDGER."""
        out = np.zeros((len(self.ends) - 1) * DIRECTIONS, LEDGER)
        at = self.rows["segment"] * DIRECTIONS + self.rows["direction"]
        for name in PLACED:
            np.add.at(out[name], at, self.rows[name])
        np.bitwise_or.at(out["machines"], at, self.rows["machines"])
        return out.reshape(-1, DIRECTIONS)


class Ledgers:
    """Makes ledgers of the same segments. A place belongs to the same segment in all of them.

    slices, place: as of `Placing`.
    """

    def __init__(self, segments: Segments) -> None:
        self.segments = segments
        placing = Placing(segments)
        self.slices, self.place = placing.slices, placing.place

    def ledger(
        self, tally: Table, slot_ns: int, from_ns: int = 0, to_ns: int = 2**62, cell_m: float = CELL_M
    ) -> Ledger:
        """Sum up rows of TALLY, of slots that begin in from_ns <= time < to_ns."""
        begins = slot(tally["key"]) * slot_ns
        tally = tally[(begins >= from_ns) & (begins < to_ns)]
        segment, inner, direction = self.placed(tally, cell_m)
        own = segment >= 0
        rows, kept = tally[own], np.stack([segment, slot(tally["key"]), direction], axis=1)[own]
        slices = np.zeros((len(PLACED), int(self.slices[-1]), DIRECTIONS), np.int64)
        for sums, name in zip(slices, PLACED, strict=True):
            np.add.at(sums, (inner[own], direction[own]), rows[name])
        total = int(tally["metres"].sum())
        share = int(rows["metres"].sum()) / total if total else 1.0
        return Ledger(_grouped(kept, rows), slices, self.slices, slot_ns, share)

    def placed(self, tally: Table, cell_m: float) -> Placed:
        """Where rows of TALLY lie: what was driven in one cell and sector is at one place, the mean of it."""
        numbers, which = np.unique(place(tally["key"]), return_inverse=True)
        places_m = corner_m(numbers, cell_m) + _inside_m(tally, which, len(numbers))
        return Placed(*(part[which] for part in self.place(places_m, heading_rad(numbers))))


def _inside_m(tally: Table, which: Ints, count: int) -> Floats:
    """Mean place (count, 2) in their cells, over the metres driven."""
    sums = np.zeros((count, 3), np.int64)
    for column, name in enumerate(("metres", "x", "y")):
        np.add.at(sums[:, column], which, tally[name])
    return np.asarray(sums[:, 1:] / (np.maximum(sums[:, :1], 1) * float(PER_M)), np.float64)


def _grouped(keys: Ints, rows: Table) -> Table:
    """Sum what has the same segment, slot and direction."""
    out, order = np.zeros(0, LEDGER), np.lexsort(keys.T[::-1])
    if not len(rows):
        return out
    keys, rows = keys[order], rows[order]
    first = np.flatnonzero(np.append(True, (np.diff(keys, axis=0) != 0).any(axis=1)))
    out = np.zeros(len(first), LEDGER)
    for index, name in enumerate(KEYS):
        out[name] = keys[first, index]
    for name in PLACED:
        out[name] = np.add.reduceat(rows[name], first)
    out["machines"] = np.bitwise_or.reduceat(rows["machines"], first)
    return out


def resistance(ledger: Ledger) -> Floats:
    """c_rr (s,) of slices, both directions; gaps of a segment between its neighbours, NaN where it has none at all."""
    known = ledger.of_slices("measured").sum(axis=1)
    c = np.where(known > 0, ledger.of_slices("c").sum(axis=1) / np.maximum(known, 1) / PER_C, np.nan)
    return filled(c, ledger.ends)


def filled(values: Floats, ends: Ints) -> Floats:
    """Values of slices, gaps within a segment interpolated and its ends continued."""
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
    """Mean (k,) over the slices of each segment; NaN where any is."""
    if not len(values):
        return np.zeros(0)
    return np.asarray(np.add.reduceat(values, ends[:-1]) / np.diff(ends), np.float64)
