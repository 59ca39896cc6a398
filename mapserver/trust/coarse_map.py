"""A coarse map of one machine over its newest driven periods.

Cells of 2 m by half hours, because only values of the same time can contradict: rain or grading may come between.
Integer sums, so order and batching do not change a bit. At 3 m/s a machine enters at most 2700 cells per period: 16
periods take 2 MB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapserver.calibration.ledger import CELL_M, PENDING_ROWS
from protocol.arrays import Floats, Ints, Table

PERIOD_S = 1800.0  # seconds within which cells are compared
PERIODS = 16  # periods kept; a repaired machine is cleared when most of them are good
UNITS_PER_M = 1024
UNITS_PER_LEVEL = 1024
# Levels are log(c_rr + 0.01). The floor keeps a balance's noise and bias (0.002 to 0.006) from drowning differences on
# concrete (0.008). Logarithms keep means symmetric across borders.
LEVEL_FLOOR = 0.01

_AXIS_BITS = 20
_HALF = 1 << (_AXIS_BITS - 1)
ROW = 1 << _AXIS_BITS  # code of one cell further north; one cell east is 1
_PERIOD_SHIFT = 2 * _AXIS_BITS
_VARIANCE_UNITS = 1024  # units per m2
_METRES, _LEVEL = 0, 1


def map_cell_m(cell_m: float) -> float:
    """Edge of these maps' cells, a multiple of the grid's."""
    return cell_m * max(1, round(CELL_M / cell_m))


@dataclass(frozen=True)
class Surface:
    """A map of one or several machines, sorted by code.

    codes: (n,) period, row, column; sums: (n, 2) metres, and metres times level, in units. std_m: stated deviation of
    positions (RMS of both axes).
    """

    codes: Ints
    sums: Ints
    std_m: float

    @cached_property
    def metres(self) -> Floats:
        """Metres driven (n,)."""
        return self.sums[:, _METRES] / UNITS_PER_M

    @cached_property
    def level(self) -> Floats:
        """Mean log(c_rr + LEVEL_FLOOR) (n,)."""
        return self.sums[:, _LEVEL] / self.sums[:, _METRES] / UNITS_PER_LEVEL

    def places(self) -> Surface:
        """The same map without periods."""
        return _summed(self.codes & ((1 << _PERIOD_SHIFT) - 1), self.sums, self.std_m)

    def without(self, part: Surface) -> Surface:
        """Subtract a map from a pooled one."""
        sums = self.sums.copy()
        sums[np.searchsorted(self.codes, part.codes)] -= part.sums
        left = sums[:, _METRES] > 0
        return Surface(self.codes[left], sums[left], self.std_m)


def pooled(surfaces: Sequence[Surface]) -> Surface:
    """Sum maps; empty for none."""
    codes = np.concatenate([np.zeros(0, np.int64), *(s.codes for s in surfaces)])
    sums = np.concatenate([np.zeros((0, 2), np.int64), *(s.sums for s in surfaces)])
    return _summed(codes, sums, float(np.sqrt(np.mean([s.std_m**2 for s in surfaces] or [0.0]))))


def block_of(codes: Ints, bits: int) -> Ints:
    """Codes of squares of 2**bits cells to a side, per period."""
    low = (1 << bits) - 1
    return codes & ~np.int64(low * ROW + low)


def _summed(codes: Ints, sums: Ints, std_m: float) -> Surface:
    """Sort by code and sum equal ones."""
    if not len(codes):
        return Surface(codes, sums, std_m)
    order = np.argsort(codes, kind="stable")  # fast, as most runs are sorted
    codes = codes[order]
    first = np.flatnonzero(np.diff(codes, prepend=-1))
    return Surface(codes[first], np.add.reduceat(sums[order], first, axis=0), std_m)


class CoarseMap:
    """Accumulates the coarse map of one machine."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = map_cell_m(cell_m)
        self._codes: Ints = np.zeros(0, np.int64)
        self._sums: Ints = np.zeros((0, 2), np.int64)
        self._pending: list[tuple[Ints, Ints]] = []
        self._waiting = 0
        self._variance = 0  # over all time: metres times position variance, metres
        self._metres = 0

    def add(self, rows: Table) -> None:
        """Add samples; those without resistance or movement do not count."""
        metres = np.rint(rows["distance_m"] * np.float64(UNITS_PER_M)).astype(np.int64)
        known = (metres > 0) & ~np.isnan(rows["c_rr"])
        if not known.all():
            rows, metres = rows[known], metres[known]
        level = np.log(np.clip(rows["c_rr"].astype(np.float64), 0.0, 1.0) + LEVEL_FLOOR)
        column = np.floor(rows["x_m"] / self._cell_m).astype(np.int64) + _HALF
        row = np.floor(rows["y_m"] / self._cell_m).astype(np.int64) + _HALF
        sums = np.empty((len(rows), 2), np.int64)
        sums[:, _METRES] = metres
        sums[:, _LEVEL] = metres * np.rint(level * UNITS_PER_LEVEL).astype(np.int64)
        variance = np.rint((rows["cov_xx_m2"] + rows["cov_yy_m2"]) * np.float64(_VARIANCE_UNITS / 2)).astype(np.int64)
        self._variance += int(metres @ variance)
        self._metres += int(metres.sum())
        self._pending.append(((rows["stamp_ns"] // round(PERIOD_S * 1e9) << _PERIOD_SHIFT) + row * ROW + column, sums))
        self._waiting += len(rows)
        if self._waiting > max(PENDING_ROWS, len(self._codes) // 4):
            self._merge()

    def surface(self) -> Surface:
        """The present map."""
        self._merge()
        return Surface(self._codes, self._sums, float(np.sqrt(self._variance / max(self._metres, 1) / _VARIANCE_UNITS)))

    def _merge(self) -> None:
        """Merge pending sums and drop the oldest periods, which never return, so it does not matter when."""
        waiting = [Surface(codes, sums, 0.0) for codes, sums in self._pending]
        self._pending, self._waiting = [], 0
        # pending sums first, which leaves two sorted runs
        whole = pooled([Surface(self._codes, self._sums, 0.0), pooled(waiting)])
        newest = np.unique(whole.codes >> _PERIOD_SHIFT)[-PERIODS:]
        start = int(np.searchsorted(whole.codes, newest[0] << _PERIOD_SHIFT)) if len(newest) else 0
        self._codes, self._sums = whole.codes[start:].copy(), whole.sums[start:].copy()
