"""Passes over segments, one by one: what a machine drove on a segment, in one direction, within a minute.

Kept by place as the tally is, but for each machine apart, minute by minute and in cells of half a segment: few rows,
from which any segments have their passes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence.fold_config import VISIT_NS
from mapserver.roads.ledger import PLACED, Ledgers
from mapserver.roads.segments import LATTICE_M
from mapserver.roads.tally import PER_C, PER_M, Tally
from protocol.arrays import Floats, Ints, Table

MINUTE_NS = VISIT_NS
MINUTES = 3 * 24 * 60  # with driving, of each machine, that are remembered
ONE_PASS = 1.3  # of a segment's length: more in two minutes are two passes
LEAST_M = 8.0  # measured on a segment, for a pass to say what its c_rr is


class Passes(NamedTuple):
    """Passes (n,) by segment, then time. minute: since 1970; machine: its number among all; c_rr: mean."""

    segment: Ints
    minute: Ints
    direction: Ints
    machine: Ints
    metres: Floats
    c_rr: Floats


class PassTally:
    """Follows what each machine drives."""

    def __init__(self) -> None:
        self._machines: dict[int, Tally] = {}

    def add(self, rows: Table, names: NDArray[np.uint64]) -> None:
        """Add samples (n,) as `Tally.add`."""
        for name in np.unique(names).tolist():
            own = self._machines.setdefault(name, Tally(MINUTE_NS, MINUTES, LATTICE_M / 2))
            own.add(rows[names == name], names[names == name])

    def passes(self, ledgers: Ledgers, from_ns: int = 0) -> Passes:
        """All passes over these segments, from a time on, of which c_rr is known."""
        parts = []
        for number, (_, tally) in enumerate(sorted(self._machines.items())):
            ledger = ledgers.ledger(tally.table(), tally.slot_ns, from_ns, cell_m=tally.cell_m)
            rows = _joined(ledger.rows, ledgers.segments.length_m)
            rows = rows[rows["measured"] >= LEAST_M * PER_M]
            c_rr = rows["c"] / (rows["measured"] * float(PER_C))
            columns = (rows["segment"], rows["slot"], rows["direction"], np.full(len(rows), number))
            parts.append((*columns, rows["metres"] / float(PER_M), c_rr))
        if not parts:
            nothing = np.zeros(0, np.int64)
            return Passes(nothing, nothing, nothing, nothing, np.zeros(0), np.zeros(0))
        joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.lexsort((joined[3], joined[2], joined[1], joined[0]))
        return Passes(*(column[order] for column in joined))


def _joined(rows: Table, length_m: Floats) -> Table:
    """Rows of LEDGER of one machine; one pass that reaches from a minute into the next is one row, of the first."""
    rows = rows[np.lexsort((rows["slot"], rows["direction"], rows["segment"]))]
    if len(rows) < 2:
        return rows
    same = (np.diff(rows["segment"]) == 0) & (np.diff(rows["direction"]) == 0) & (np.diff(rows["slot"]) == 1)
    both_m = (rows["metres"][1:] + rows["metres"][:-1]) / float(PER_M)
    goes_on = same & (both_m <= ONE_PASS * length_m[rows["segment"][1:]])
    first = np.flatnonzero(np.append(True, ~goes_on))
    out = rows[first].copy()
    for name in PLACED:
        out[name] = np.add.reduceat(rows[name], first)
    return out
