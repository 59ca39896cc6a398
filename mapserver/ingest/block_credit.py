"""Credit for new ground: a machine may open as many blocks of the grid as it has driven for. No files, no clock.

A block costs memory for as long as the map lives, and a sample of 80 bytes opens up to four, so samples that are
scattered over a site would cost the server 14 kB each. Metres driven earn credit and each block that nobody has opened
spends it. A drive on new ground earns at least what it spends, wherever its positions lie within three standard
deviations of the truth; jumps spend from a store of credit, which the next metres fill up again.

What is refused is never journalled, so the map is a function of the journal as before. Credit itself is not kept: a
server that starts again gives each machine all of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.sample_kernels import block_key, survey
from mapserver.evidence.timeline import Block
from protocol.arrays import AnyArray, Table
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import empty
from protocol.site.geometry import BLOCK_CELLS

MAX_STEP_M = 2.0  # that a sample earns for at most: agents make one every 0.5 m
JUMPS = 50  # to new ground, each of as many blocks as a sample can open: 200 blocks with cells of 1 m
SIGMAS = 3.0  # that positions may be off


class Account(NamedTuple):
    """What a machine may open, in blocks, and where its last sample was; NaN where that is not known."""

    credit: float
    x_m: float = math.nan
    y_m: float = math.nan


class BlockCredit:
    """The accounts of all machines, and which blocks are open.

    `spend` takes effect with `keep`, as rows of a journal do with their commit, or not at all, with `drop`.
    most: credit that a machine can have [blocks]. per_m: that a metre earns.
    """

    def __init__(self, cell_m: float, config: FoldConfig, opened: Iterable[Block]) -> None:
        """opened: blocks that have evidence."""
        self._limits = cell_m, STD_FLOOR_M**2, config.std_cap_m**2
        self._driven_m, self._keys, self._at = np.empty(1), np.empty(1, np.int64), np.empty(1, np.int64)
        self._opened, self._accounts = {block_key(*block) for block in opened}, dict[str, Account]()
        self._new_opened, self._new_accounts = set[int](), dict[str, Account]()
        self._off_m = SIGMAS * math.hypot(config.std_cap_m, STD_FLOOR_M)
        # What moves along a line of new ground is a square, as wide as the votes of a sample and what positions are off
        # to either side. At 45 degrees it meets sqrt(2) times as many blocks as along an axis.
        edge = config.widest_cells(cell_m)
        swept = BLOCK_CELLS + edge - 1 + 2 * self._off_m / cell_m
        self.per_m = math.sqrt(2) * swept / (BLOCK_CELLS**2 * cell_m)
        self.most = float(JUMPS * (2 + (edge - 2) // BLOCK_CELLS) ** 2)

    @property
    def opened(self) -> int:
        """How many blocks are open."""
        return len(self._opened) + len(self._new_opened)

    def spend(self, machine: str, rows: Table, trimmed: int = 0) -> None:
        """Open the blocks of a machine's new samples; trimmed: samples of their batch before them.

        MessageError names the first sample that the machine has no credit for; then nothing is opened. A sample that is
        refused alone is given up by its sender, so the machine is there from then on, and what it drove since counts.
        """
        before = self._new_accounts.get(machine) or self._accounts.get(machine) or Account(self.most)
        credit, counted_m, new = before.credit, 0.0, set[int]()
        for key, row in self._survey(rows, before):
            if key in self._opened or key in self._new_opened or key in new:
                continue
            driven_m = self._driven_m.item(row)
            credit, counted_m = self._earned(credit, driven_m - counted_m), driven_m
            if credit < 1:
                if len(rows) == 1:
                    self._pass_by(machine, rows[0], before)
                raise _refusal(rows[row], row + trimmed)
            credit -= 1
            new.add(key)
        credit = self._earned(credit, self._driven_m.item(len(rows) - 1) - counted_m)
        self._new_accounts[machine] = Account(credit, rows["x_m"].item(-1), rows["y_m"].item(-1))
        self._new_opened |= new

    def keep(self) -> None:
        """Have what was spent count."""
        self._accounts |= self._new_accounts
        self._opened |= self._new_opened
        self.drop()

    def drop(self) -> None:
        """Have nothing count that was spent since the last `keep`."""
        self._new_accounts, self._new_opened = {}, set()

    def _pass_by(self, machine: str, row: AnyArray, before: Account) -> None:
        """Have a machine be where it is refused; metres to there count where they are no jump."""
        x_m, y_m, distance_m = (float(row[name]) for name in ("x_m", "y_m", "distance_m"))
        shift_m = math.hypot(x_m - before.x_m, y_m - before.y_m)
        driven_m = min(shift_m, distance_m, MAX_STEP_M) if shift_m <= distance_m + self._off_m else 0.0
        self._new_accounts[machine] = Account(self._earned(before.credit, driven_m), x_m, y_m)

    def _earned(self, credit: float, driven_m: float) -> float:
        return min(credit + self.per_m * driven_m, self.most)

    def _survey(self, rows: Table, before: Account) -> Iterable[tuple[int, int]]:
        """Which blocks samples come into, key and sample, in their order; metres until each are in `_driven_m` then."""
        if len(rows) > len(self._driven_m):
            self._driven_m = np.empty(len(rows))
        while True:
            used = survey(
                rows, self._limits, (before.x_m, before.y_m, MAX_STEP_M), self._driven_m, self._keys, self._at
            )
            if used <= len(self._keys):
                return zip(self._keys[:used].tolist(), self._at[:used].tolist(), strict=True) if used else ()
            self._keys, self._at = np.empty(used, np.int64), np.empty(used, np.int64)


def _refusal(row: AnyArray, number: int) -> MessageError:
    place = f"{row['x_m']:.0f}, {row['y_m']:.0f} m"
    problem = f"{place} is new ground, and the machine has not driven far enough to open more: look at its positions"
    return MessageError(Refusal.SCATTERED, problem, field="x_m", row=number)


def warm_up(config: FoldConfig) -> None:
    """Compile the kernel, or read it from its cache, before a batch waits for it."""
    BlockCredit(1.0, config, ()).spend("", empty(1))
