"""Passes: what one machine drove on a segment in one direction within a minute.

Kept by machine, minute and half segments: few rows, which give the passes of any segments.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence.fold_config import VISIT_NS
from mapserver.roads.cutting import LATTICE_M
from mapserver.roads.ledger import Ledgers
from mapserver.roads.tally import PER_C, PER_M, TALLY, Tally, slot
from protocol.arrays import Floats, Ints, Table

MINUTE_NS, CELL_M = VISIT_NS, LATTICE_M / 2
MINUTES = 3 * 24 * 60  # driven minutes kept per machine
ONE_PASS = 1.3  # segment lengths; more in two minutes are two passes
LEAST_M = 5.0  # measured metres a pass needs: half of the shortest segments


class Passes(NamedTuple):
    """Passes (n,) by segment, then time. minute: since 1970; machine: index."""

    segment: Ints
    minute: Ints
    direction: Ints
    machine: Ints
    metres: Floats
    c_rr: Floats


class PassTally:
    """Tallies of single machines."""

    def __init__(self) -> None:
        self._machines: dict[int, Tally] = {}

    def add(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """Add samples (n,) as `Tally.add`."""
        for name in np.unique(names).tolist():
            own = self._machines.setdefault(name, Tally(MINUTE_NS, MINUTES, CELL_M))
            own.add(rows[names == name], names[names == name])

    @property
    def since_ns(self) -> int:
        """All passes of all machines since then are known."""
        return max((tally.since_ns for tally in self._machines.values()), default=0)

    def passes(self, ledgers: Ledgers, from_ns: int = 0) -> Passes:
        """Passes with known c_rr."""
        tables = [tally.table() for _, tally in sorted(self._machines.items())]
        rows: Table = np.concatenate([np.zeros(0, TALLY), *tables])
        machine = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
        segment, _, direction = ledgers.placed(rows, CELL_M)
        minute = slot(rows["key"])
        order = np.lexsort((minute, direction, machine, segment))
        order = order[(segment[order] >= 0) & (minute[order] * MINUTE_NS >= from_ns)]
        keys = np.stack([segment, machine, direction, minute])[:, order]
        sums = np.stack([rows[name][order] for name in ("metres", "measured", "c")])
        (segment, machine, direction, minute), (metres, measured, c) = _joined(keys, sums, ledgers.segments.length_m)
        known = np.flatnonzero(measured >= LEAST_M * PER_M)
        known = known[np.lexsort((machine[known], direction[known], minute[known], segment[known]))]
        segment, minute, direction, machine = (column[known] for column in (segment, minute, direction, machine))
        metres_m, c_rr = metres[known] / float(PER_M), c[known] / (measured[known] * float(PER_C))
        return Passes(segment, minute, direction, machine, metres_m, c_rr)


def _joined(keys: Ints, sums: Ints, length_m: Floats) -> tuple[Ints, Ints]:
    """Sum columns of equal keys (segment, machine, direction, minute), sorted.

    A pass that reaches into the next minute belongs to the first.
    """
    for most in (0, 1):
        same = (np.diff(keys[:3], axis=1) == 0).all(axis=0) & (np.diff(keys[3]) == most)
        if most:
            both_m = (sums[0, 1:] + sums[0, :-1]) / float(PER_M)
            same &= both_m <= ONE_PASS * length_m[keys[0, 1:]]
        if keys.shape[1]:
            first = np.flatnonzero(np.append(True, ~same))
            keys, sums = keys[:, first], np.add.reduceat(sums, first, axis=1)
    return keys, sums
