"""What trust remembers of one machine: a coarse map of its own of the newest periods in which it drove.

A key is a cell of about 2 m in a period of half an hour, because only values of the same ground at the same time can
contradict each other: between two times it may have rained, or a zone may have been repaved. Values are sums of
integers, so that any order and any batching of the rows give the same bits. A machine at 3 m/s enters at most 2700 new
cells in half an hour: 16 periods are at most 2 MB of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapserver.calibration.ledger import CELL_M, PENDING_ROWS
from protocol.arrays import Floats, Ints, Table

PERIOD_S = 1800.0  # only cells driven in the same period are compared: rain and repaving are no contradiction
PERIODS = 16  # that are remembered; a repaired machine is cleared when most of them are good
UNITS_PER_M = 1024
UNITS_PER_LEVEL = 1024
# Levels are log(c_rr + 0.01): the noise and the zero error of a balance are additive (0.002 to 0.006), and without the
# floor they would drown the differences on concrete (0.008). A mean of levels stays symmetric across borders.
LEVEL_FLOOR = 0.01

_AXIS_BITS = 20
_HALF = 1 << (_AXIS_BITS - 1)
ROW = 1 << _AXIS_BITS  # one cell further north, in codes; one cell further east is 1
_PERIOD_SHIFT = 2 * _AXIS_BITS
_VARIANCE_UNITS = 1024  # per m2
_METRES, _LEVEL = 0, 1


def map_cell_m(cell_m: float) -> float:
    """Edge of these maps' cells, whole cells of the site's grid."""
    return cell_m * max(1, round(CELL_M / cell_m))


@dataclass(frozen=True)
class Surface:
    """A map of one machine or of several together, sorted by code.

    codes: (n,) period, row, column; sums: (n, 2) metres driven there, and metres times level, in units.
    std_m: of the positions, as they say themselves (root mean square over both axes).
    """

    codes: Ints
    sums: Ints
    std_m: float

    @cached_property
    def metres(self) -> Floats:
        """Metres driven in each cell, (n,)."""
        return self.sums[:, _METRES] / UNITS_PER_M

    @cached_property
    def level(self) -> Floats:
        """Mean of log(c_rr + LEVEL_FLOOR) in each cell, (n,)."""
        return self.sums[:, _LEVEL] / self.sums[:, _METRES] / UNITS_PER_LEVEL

    def places(self) -> Surface:
        """Return the same map without periods."""
        return _summed(self.codes & ((1 << _PERIOD_SHIFT) - 1), self.sums, self.std_m)

    def without(self, part: Surface) -> Surface:
        """Take one of the maps out of a pooled one."""
        sums = self.sums.copy()
        sums[np.searchsorted(self.codes, part.codes)] -= part.sums
        left = sums[:, _METRES] > 0
        return Surface(self.codes[left], sums[left], self.std_m)


def pooled(surfaces: Sequence[Surface]) -> Surface:
    """Return the map of several machines together; none of them gives an empty one."""
    codes = np.concatenate([np.zeros(0, np.int64), *(s.codes for s in surfaces)])
    sums = np.concatenate([np.zeros((0, 2), np.int64), *(s.sums for s in surfaces)])
    return _summed(codes, sums, float(np.sqrt(np.mean([s.std_m**2 for s in surfaces] or [0.0]))))


def block_of(codes: Ints, bits: int) -> Ints:
    """Codes of the squares of 2**bits by 2**bits cells around these cells, per period."""
    low = (1 << bits) - 1
    return codes & ~np.int64(low * ROW + low)


def _summed(codes: Ints, sums: Ints, std_m: float) -> Surface:
    """Sort by code, and sum what has the same one."""
    if not len(codes):
        return Surface(codes, sums, std_m)
    order = np.argsort(codes, kind="stable")  # mostly sorted runs already
    codes = codes[order]
    first = np.flatnonzero(np.diff(codes, prepend=-1))
    return Surface(codes[first], np.add.reduceat(sums[order], first, axis=0), std_m)


class CoarseMap:
    """Sums of one machine, for the newest periods in which it drove."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = map_cell_m(cell_m)
        self._codes: Ints = np.zeros(0, np.int64)
        self._sums: Ints = np.zeros((0, 2), np.int64)
        self._pending: list[tuple[Ints, Ints]] = []
        self._waiting = 0
        self._variance = 0  # sum of metres times variance of position, and of metres, over all time
        self._metres = 0

    def add(self, rows: Table) -> None:
        """Add samples; those without resistance, and those of a machine that stands, say nothing about the ground."""
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
        """Return the map as it is now."""
        self._merge()
        return Surface(self._codes, self._sums, float(np.sqrt(self._variance / max(self._metres, 1) / _VARIANCE_UNITS)))

    def _merge(self) -> None:
        """Sum what waits into the map, and forget the oldest periods.

        A period that is forgotten can never come back among the newest ones, so that when this runs has no influence.
        """
        waiting = [Surface(codes, sums, 0.0) for codes, sums in self._pending]
        self._pending, self._waiting = [], 0
        # what waits is small: summed first, it leaves two sorted runs to merge
        whole = pooled([Surface(self._codes, self._sums, 0.0), pooled(waiting)])
        newest = np.unique(whole.codes >> _PERIOD_SHIFT)[-PERIODS:]
        start = int(np.searchsorted(whole.codes, newest[0] << _PERIOD_SHIFT)) if len(newest) else 0
        self._codes, self._sums = whole.codes[start:].copy(), whole.sums[start:].copy()
