"""Stays: what one machine measured while it crossed one coarse cell, as sums of integers.

A key says which 10 s, which cell of about 2 m, and whether ahead or in reverse, so that a sample alone knows the stay
that it belongs to: any order and any batching of the samples give the same stays. The few that last beyond the end of
their 10 s become two, one behind the other.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.calibration.correction import HEADING_TABLE, heading_index, measured
from protocol.arrays import Ints, Table
from protocol.machine.samples import APPLIED

SLOT_NS = 10_000_000_000
VALUE_UNITS = 100_000  # per unit of c_rr and of slope
PLACE_UNITS = 1000  # per metre and per second
_AXIS_BITS = 16  # of columns and rows: 131 km of cells of 2 m
_HALF = 1 << (_AXIS_BITS - 1)
SLOT_SHIFT = 2 * _AXIS_BITS + 1
_HEADING_SHIFT = 6  # of the table's integers: a stay of 16 000 samples fits
HEADING_UNITS = 1 << (20 - _HEADING_SHIFT)

# n samples, of which `known` have c_rr. Sums: ms since the slot began; mm from the cell's corner; c_rr, gradient east,
# gradient north in VALUE_UNITS; cosine and sine of the heading in HEADING_UNITS; speed in mm/s; distance driven in mm.
# What the machine stated as applied, in VALUE_UNITS, has no part in what was measured.
MEASURED = ("n", "known", "time", "x", "y", "c_rr", "east", "north", "cosine", "sine", "speed", "distance")
SUMS = (*MEASURED, *APPLIED)
STAY = np.dtype([("key", "<i8"), *((name, "<i4") for name in SUMS)])


def stays(rows: Table, cell_m: float) -> Table:
    """Stays (k,) of samples (n,) of one machine that have a slope, by their keys; of what it measured."""
    keys, sums = np.empty(len(rows), np.int64), np.empty((len(rows), len(SUMS)), np.int32)
    used = _measure(measured(rows), rows, cell_m, HEADING_TABLE, keys, sums)
    return summed(keys[:used], sums[:used])


def summed(keys: Ints, sums: Any) -> Table:
    """Sum what has the same key."""
    order = np.argsort(keys, kind="stable")  # mostly sorted runs already
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    out = np.empty(len(first), STAY)
    out["key"] = keys[first]
    if len(first):
        totals = np.add.reduceat(sums[order], first, axis=0)
        for i, name in enumerate(SUMS):
            out[name] = totals[:, i]
    return out


def merged(one: Table, other: Table) -> Table:
    """Stays of both."""
    both = np.concatenate([one, other])
    sums = np.stack([both[name] for name in SUMS], axis=1)
    return summed(both["key"], sums)


def slot(keys: Ints) -> Ints:
    """Which 10 s, in SLOT_NS since 1970."""
    return keys >> SLOT_SHIFT


def cell(keys: Ints) -> Ints:
    """A number of the cell."""
    return (keys >> 1) & ((1 << (2 * _AXIS_BITS)) - 1)


def column_row(cells: Ints) -> tuple[Ints, Ints]:
    """Column and row of cells, from the site's origin."""
    return (cells & ((1 << _AXIS_BITS) - 1)) - _HALF, (cells >> _AXIS_BITS) - _HALF


def direction(keys: Ints) -> Ints:
    """+1 ahead, -1 in reverse."""
    return 1 - 2 * (keys & 1)


@numba.njit(cache=True, nogil=True)
def _measure(rows: Any, sent: Any, cell_m: float, headings: Any, keys: Any, sums: Any) -> int:
    """Keys and sums of single samples; returns how many there are: without a slope a sample shows nothing.

    rows: as measured; sent: the same as they came in.
    """
    used = 0
    for i in range(len(rows)):
        row = rows[i]
        if np.isnan(row.grade_e) or row.distance_m <= 0.0:
            continue
        column, line = np.floor(row.x_m / cell_m), np.floor(row.y_m / cell_m)
        if abs(column) >= _HALF or abs(line) >= _HALF:
            continue
        at = (np.int64(line) + _HALF) << _AXIS_BITS | (np.int64(column) + _HALF)
        backwards = np.int64(row.speed_mps < 0.0)
        keys[used] = (row.stamp_ns // SLOT_NS) << SLOT_SHIFT | at << 1 | backwards
        out = sums[used]
        known = not np.isnan(row.c_rr)
        out[0], out[1] = 1, known
        out[2] = row.stamp_ns % SLOT_NS // (1_000_000_000 // PLACE_UNITS)
        out[3] = np.int32((row.x_m - column * cell_m) * PLACE_UNITS)
        out[4] = np.int32((row.y_m - line * cell_m) * PLACE_UNITS)
        out[5] = np.int32(np.rint(np.float64(row.c_rr) * VALUE_UNITS)) if known else 0
        out[6] = np.int32(np.rint(np.float64(row.grade_e) * VALUE_UNITS))
        out[7] = np.int32(np.rint(np.float64(row.grade_n) * VALUE_UNITS))
        unit = heading_index(np.float64(row.heading_rad))
        out[8], out[9] = headings[unit, 0] >> _HEADING_SHIFT, headings[unit, 1] >> _HEADING_SHIFT
        out[10] = np.int32(np.rint(abs(np.float64(row.speed_mps)) * PLACE_UNITS))
        out[11] = np.int32(np.rint(np.float64(row.distance_m) * PLACE_UNITS))
        out[12] = np.int32(np.rint(np.float64(sent[i].applied_zero) * VALUE_UNITS))
        out[13] = np.int32(np.rint(np.float64(sent[i].applied_scale) * VALUE_UNITS))
        used += 1
    return used
