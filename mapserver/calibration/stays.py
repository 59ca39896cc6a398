"""Stays: integer sums of a machine's crossing of a coarse cell.

A sample alone gives its key (10 s slot, cell, direction), so order and batching do not matter. A stay across a slot's
end becomes two.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.calibration.correction import HEADING_TABLE, heading_index, measured
from protocol.arrays import Ints, Table
from protocol.machine.samples import APPLIED

SLOT_NS = 10_000_000_000
VALUE_UNITS = 100_000  # units per unit of c_rr or slope
PLACE_UNITS = 1000  # units per metre or second
_AXIS_BITS = 16  # bits of columns and rows: 131 km of 2 m cells
_HALF = 1 << (_AXIS_BITS - 1)
SLOT_SHIFT = 2 * _AXIS_BITS + 1
_HEADING_SHIFT = 6  # shift of the heading table's integers, so that sums of 16 000 samples fit
HEADING_UNITS = 1 << (20 - _HEADING_SHIFT)

# n samples, `known` with c_rr. Sums: ms in the slot; mm in the cell; c_rr and gradient in VALUE_UNITS; heading in
# HEADING_UNITS; mm/s; mm driven. APPLIED: as stated, in VALUE_UNITS.
MEASURED = ("n", "known", "time", "x", "y", "c_rr", "east", "north", "cosine", "sine", "speed", "distance")
SUMS = (*MEASURED, *APPLIED)
STAY = np.dtype([("key", "<i8"), *((name, "<i4") for name in SUMS)])


def stays(rows: Table, cell_m: float) -> Table:
    """Stays (k,) by key, as measured, of a machine's samples (n,) with a slope."""
    keys, sums = np.empty(len(rows), np.int64), np.empty((len(rows), len(SUMS)), np.int32)
    used = _measure(measured(rows), rows, cell_m, HEADING_TABLE, keys, sums)
    return summed(keys[:used], sums[:used])


def summed(keys: Ints, sums: Any) -> Table:
    """Sum equal keys."""
    order = np.argsort(keys, kind="stable")  # fast, as most runs are sorted
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
    """Merge two tables."""
    both = np.concatenate([one, other])
    sums = np.stack([both[name] for name in SUMS], axis=1)
    return summed(both["key"], sums)


def slot(keys: Ints) -> Ints:
    """Slot number, in SLOT_NS since 1970."""
    return keys >> SLOT_SHIFT


def cell(keys: Ints) -> Ints:
    """Cell number."""
    return (keys >> 1) & ((1 << (2 * _AXIS_BITS)) - 1)


def column_row(cells: Ints) -> tuple[Ints, Ints]:
    """Column and row from the site's origin."""
    return (cells & ((1 << _AXIS_BITS) - 1)) - _HALF, (cells >> _AXIS_BITS) - _HALF


def direction(keys: Ints) -> Ints:
    """+1 ahead, -1 in reverse."""
    return 1 - 2 * (keys & 1)


@numba.njit(cache=True, nogil=True)
def _measure(rows: Any, sent: Any, cell_m: float, headings: Any, keys: Any, sums: Any) -> int:
    """Returns the number of samples with a slope. rows: as measured; sent: as received."""
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
