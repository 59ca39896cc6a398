"""The tally: traffic by time, place and direction as integer sums, from which any segment gets its traffic.

Places are cells independent of roads, so a road that moves does not move traffic. Order and batching of samples do not
matter, bit for bit.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mapserver.roads.cutting import LATTICE_M
from protocol.arrays import Floats, Ints, Table
from protocol.units import HOUR_NS

CELL_M = LATTICE_M / 10  # cell edge [m]; divides the lattice's cell
HOURS = 120  # driven hours kept; the journal has older ones
SECTORS = 16  # headings per turn, the first centred on east
PER_M = 1000  # units per metre, also of positions
PER_C = 100_000  # units per unit of c_rr and gradient
SLOWEST_MPS = 0.1  # lower bound [m/s]: standing would take for ever
_C2_SHIFT = 100  # units of squares over PER_C squared, so that hourly sums fit
_AXIS_BITS, _SECTOR_BITS = 17, 4  # sites reach 100 km from their origin
_HALF = 1 << (_AXIS_BITS - 1)  # 25 bits remain for slots of a minute or more
_SLOT_SHIFT = 2 * _AXIS_BITS + _SECTOR_BITS
_PENDING_ROWS = 16_384  # rows merged at once, because merging sorts everything

# Metres driven, and those with known mass (weighed), c_rr (measured), gradient (graded), litres (fuelled). Times
# metres: kg, c_rr and its square, gradient, position from the corner. Of fuelled: litres, milliseconds, squared speed
# times metres.
SUMS = (
    *("metres", "weighed", "measured", "graded", "kg", "c", "c2", "east", "north"),
    *("fuelled", "fuel", "ms", "v2", "x", "y"),
)
PER_L, PER_V2 = 1_000_000, 100  # units per litre, and per squared speed
TALLY = np.dtype([("key", "<i8"), *((name, "<i8") for name in SUMS), ("machines", "<u8")])
_SECTOR_RAD = 2 * np.pi / SECTORS


class Tally:
    """Sums by span of time; `slots` driven spans are kept, newest first. since_ns: begin of those, 0 for all."""

    def __init__(self, slot_ns: int = HOUR_NS, slots: int = HOURS, cell_m: float = CELL_M) -> None:
        """cell_m: divides the lattice's cell."""
        self.slot_ns, self.cell_m, self._slots = slot_ns, cell_m, slots
        self._table: Table = np.zeros(0, TALLY)
        self._pending: list[Table] = []
        self._waiting = self.since_ns = 0

    def add(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """Add corrected samples (n,) that may vote by position; names (n,): hashes of machine names."""
        new = tally(rows, names, self.slot_ns, self.cell_m)
        self._pending.append(new)
        self._waiting += len(new)
        if self._waiting > max(_PENDING_ROWS, len(self._table) // 4):
            self.table()

    def table(self) -> Table:
        """All rows, sorted by key. A forgotten span never returns, so it does not matter when this is called."""
        if self._pending:
            whole = summed(np.concatenate([self._table, *self._pending]))
            self._pending, self._waiting = [], 0
            each = slot(whole["key"])
            kept = np.unique(each)[-self._slots :]
            self._table = whole[int(np.searchsorted(each, kept[0])) :].copy() if len(kept) else whole
            if len(self._table) < len(whole):
                self.since_ns = int(kept[0]) * self.slot_ns
        return self._table


def tally(rows: Table, names: NDArray[np.uint64], slot_ns: int, cell_m: float = CELL_M) -> Table:
    """Tally of samples (n,); names (n,): hashes of machine names."""
    out = np.zeros(len(rows), TALLY)
    return summed(out[: _measure(rows, names, cell_m, slot_ns, out)])


def summed(rows: Table) -> Table:
    """Sum rows of equal key; sorted by it."""
    order = np.argsort(rows["key"], kind="stable")  # fast, as most runs are sorted
    rows = rows[order]
    first = np.flatnonzero(np.diff(rows["key"], prepend=-1))
    out = np.zeros(len(first), TALLY)
    if len(first):
        out["key"] = rows["key"][first]
        for name in SUMS:
            out[name] = np.add.reduceat(rows[name], first)
        out["machines"] = np.bitwise_or.reduceat(rows["machines"], first)
    return out


def between(table: Table, first: int, end: int) -> Table:
    """Rows of slots first <= slot < end; a view."""
    bounds = (bisect_left(table["key"], slots << _SLOT_SHIFT) for slots in (first, end))
    return table[slice(*bounds)]


@register_jitable  # numpy outside of kernels: a column of one row has another layout, which would be compiled too
def slot(keys: Any) -> Any:
    """Number of the time span since 1970."""
    return keys >> _SLOT_SHIFT


@numba.njit(cache=True, nogil=True)
def place(keys: Any) -> Any:
    """Number of cell and sector."""
    return keys & ((1 << _SLOT_SHIFT) - 1)


def corner_m(keys: Ints, cell_m: float) -> Floats:
    """South-west corners (n, 2)."""
    column = ((keys >> _SECTOR_BITS) & ((1 << _AXIS_BITS) - 1)) - _HALF
    row = ((keys >> (_SECTOR_BITS + _AXIS_BITS)) & ((1 << _AXIS_BITS) - 1)) - _HALF
    return np.asarray(np.stack([column, row], axis=1) * cell_m, np.float64)


def heading_rad(keys: Ints) -> Floats:
    """Direction of travel [rad]: the middle of the sector."""
    return np.asarray((keys & ((1 << _SECTOR_BITS) - 1)) * _SECTOR_RAD, np.float64)


def squares_of(c2: Ints) -> Floats:
    """c_rr squared times metres."""
    return np.asarray(c2 * (_C2_SHIFT / PER_C**2 / PER_M), np.float64)


@numba.njit(cache=True, nogil=True)
def _measure(rows: Any, names: Any, cell_m: float, slot_ns: int, out: Any) -> int:
    """Returns the number of samples that moved."""
    used = 0
    for i in range(len(rows)):
        row = rows[i]
        metres = np.int64(np.rint(np.float64(row.distance_m) * PER_M))
        column, line = np.floor(row.x_m / cell_m), np.floor(row.y_m / cell_m)
        if metres <= 0 or abs(column) >= _HALF or abs(line) >= _HALF:
            continue
        sector = np.int64(np.floor(np.float64(row.heading_rad) / _SECTOR_RAD + 0.5))
        sector = (sector + (SECTORS // 2 if row.speed_mps < 0.0 else 0)) % SECTORS
        at = (np.int64(line) + _HALF) << _AXIS_BITS | (np.int64(column) + _HALF)
        sums = out[used]
        sums.key = (row.stamp_ns // slot_ns) << _SLOT_SHIFT | at << _SECTOR_BITS | sector
        sums.metres = metres
        sums.machines = np.uint64(1) << (names[i] >> np.uint64(58))
        sums.x = metres * np.int64((row.x_m - column * cell_m) * PER_M)
        sums.y = metres * np.int64((row.y_m - line * cell_m) * PER_M)
        if not np.isnan(row.mass_kg):
            sums.weighed = metres
            sums.kg = metres * np.int64(np.rint(np.float64(row.mass_kg)))
        if not np.isnan(row.c_rr):
            c = np.int64(np.rint(min(max(np.float64(row.c_rr), -1.0), 1.0) * PER_C))
            sums.measured = metres
            sums.c = metres * c
            sums.c2 = metres * (c * c // _C2_SHIFT)
        if not np.isnan(row.grade_e):
            sums.graded = metres
            sums.east = metres * np.int64(np.rint(np.float64(row.grade_e) * PER_C))
            sums.north = metres * np.int64(np.rint(np.float64(row.grade_n) * PER_C))
        if not np.isnan(row.fuel_l):
            speed = abs(np.float64(row.speed_mps))
            sums.fuelled = metres
            sums.fuel = np.int64(np.rint(np.float64(row.fuel_l) * PER_L))
            sums.ms = np.int64(metres / max(speed, SLOWEST_MPS))
            sums.v2 = metres * np.int64(np.rint(speed * speed * PER_V2))
        used += 1
    return used
