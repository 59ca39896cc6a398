"""A machine's ledger of stays in its newest driven epochs.

Integer sums: order and batching of samples do not change a bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mapserver.calibration.correction import LAST_NS
from mapserver.calibration.stays import SLOT_NS, SLOT_SHIFT, STAY, VALUE_UNITS, merged, stays
from protocol.arrays import Ints, Table
from protocol.machine.samples import APPLIED, SAMPLE_DTYPE

CELL_M = 2.0  # cell edge [m], one deviation of a position: finer cells would compare single samples
EPOCH_SLOTS = 30  # slots per epoch: 300 s, the map's time bucket
EPOCH_NS = EPOCH_SLOTS * SLOT_NS
EPOCHS = 48  # epochs kept, 4 h of driving; older corrections stay as decided
PENDING_ROWS = 4096  # stays merged at once, because merging sorts everything


class StayLedger:
    """Stays of one machine. cell_m: edge of the cells.

    epochs: kept. until_ns: later stamps may come from a fast clock; as many of their epochs are kept apart.
    """

    def __init__(self, cell_m: float = CELL_M) -> None:
        self.epochs, self.until_ns = EPOCHS, LAST_NS
        self._cell_m = cell_m
        self._stays: Table = np.zeros(0, STAY)
        self._pending: list[Table] = []
        self._waiting = 0

    @property
    def nbytes(self) -> int:
        """Memory used."""
        return self._stays.nbytes + sum(each.nbytes for each in self._pending)

    def add(self, rows: Table) -> None:
        """Add samples whose position is certain enough to vote."""
        new = stays(rows, self._cell_m)
        self._pending.append(new)
        self._waiting += len(new)
        if self._waiting > max(PENDING_ROWS, len(self._stays) // 4):
            self._merge()

    @property
    def newest_ns(self) -> int:
        """Begin of the newest epoch, 0 for none."""
        self._merge()
        return int(epochs_of(self._stays)[-1]) * EPOCH_NS if len(self._stays) else 0

    def stays(self, from_ns: int = 0) -> Table:
        """Stays of the newest epochs from from_ns to `until_ns`, by key."""
        self._merge()
        each = epochs_of(self._stays)
        first, end = np.searchsorted(each, [-(-from_ns // EPOCH_NS), self.until_ns // EPOCH_NS + 1]).tolist()
        return newest(self._stays[first:end], self.epochs)

    def _merge(self) -> None:
        """Dropped epochs never return, so it does not matter when this runs."""
        if not self._pending:
            return
        whole = merged(self._stays, np.concatenate(self._pending))
        self._pending, self._waiting = [], 0
        later = int(np.searchsorted(epochs_of(whole), self.until_ns // EPOCH_NS + 1))
        self._stays = np.concatenate([newest(part, self.epochs) for part in (whole[:later], whole[later:])])


class Stated(NamedTuple):
    """What a machine applied in an epoch, and how much it changed (std)."""

    zero: float = 0.0
    scale: float = 0.0
    zero_std: float = 0.0
    scale_std: float = 0.0


NOTHING_STATED = Stated()


def epochs_of(table: Table) -> Ints:
    """Epoch of each stay, in EPOCH_NS since 1970."""
    return np.asarray((table["key"] >> SLOT_SHIFT) // EPOCH_SLOTS, np.int64)


def newest(table: Table, epochs: int) -> Table:
    """Stays of the newest epochs; sorted by key."""
    each = epochs_of(table)
    kept = np.unique(each)[-epochs:]
    return table[int(np.searchsorted(each, kept[0])) if len(kept) else 0 :]


def stated(table: Table) -> Mapping[int, Stated]:
    """Values applied in each epoch, over all samples."""
    numbers, which = np.unique(epochs_of(table), return_inverse=True)
    n = np.bincount(which, table["n"])
    means, spreads = [], []
    for name in APPLIED:
        each = table[name] / (table["n"] * float(VALUE_UNITS))
        means.append(np.bincount(which, each * table["n"]) / n)
        spreads.append(np.sqrt(np.bincount(which, (each - means[-1][which]) ** 2 * table["n"]) / n))
    values = np.stack([*means, *spreads], axis=1).tolist()
    return {number: Stated(*row) for number, row in zip(numbers.tolist(), values, strict=True)}


def warm_up() -> None:
    """Compile the kernels of ledgers and corrections, or load them."""
    rows = np.zeros(1, SAMPLE_DTYPE)
    rows["applied_zero"] = 0.01
    StayLedger().add(rows)
