"""Credit for new ground: a machine may open as many blocks of the grid as it has driven for. No files, no clock.

A block costs memory for as long as the map lives, and a sample of 80 bytes opens up to four: scattered over a site,
each would cost 14 kB. What is refused is never journalled, so the map stays a function of the journal. Credit is not
kept: after a start of the server each machine has that of a new one (docs/decisions/0011-credit-for-new-ground.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.sample_kernels import SIGMAS, block_key, survey
from mapserver.evidence.timeline import Block
from protocol.arrays import Table
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import empty
from protocol.site.geometry import BLOCK_CELLS

JUMPS = 50  # to new ground, each of as many blocks as a sample can open: 200 blocks with cells of 1 m
JUMP_M = 200.0  # driven for each further one


class Account(NamedTuple):
    """Blocks that a machine may open by jumps and as it drives on, where it is, and whether it has jumped there."""

    jumps: float
    driven: float = 0.0
    x_m: float = math.nan
    y_m: float = math.nan
    has_jumped: bool = True


class BlockCredit:
    """The accounts of all machines. opened: keys of the blocks that are open.

    most: credit of either kind [blocks]. per_m, jumps_per_m: that a metre earns.
    """

    def __init__(self, cell_m: float, config: FoldConfig, opened: Iterable[Block]) -> None:
        self.opened, self._accounts = {block_key(*block) for block in opened}, dict[str, Account]()
        self._limits, self._entered = (cell_m, STD_FLOOR_M**2, config.std_cap_m**2), np.empty((1, 2), np.int64)
        # What moves over new ground is a square, as wide as a sample's votes and what positions are off to either side.
        # At 45 degrees it meets sqrt(2) times as many blocks as along an axis.
        std = math.hypot(config.std_cap_m, STD_FLOOR_M) / cell_m
        edge = 2 * math.ceil(2 * std) + 1
        swept = BLOCK_CELLS + edge - 1 + 2 * SIGMAS * std
        self.per_m = math.sqrt(2) * swept / (BLOCK_CELLS**2 * cell_m)
        blocks = (2 + (edge - 2) // BLOCK_CELLS) ** 2
        self.most, self.jumps_per_m = float(JUMPS * blocks), blocks / JUMP_M

    def spend(self, machine: str, rows: Table, trimmed: int = 0) -> None:
        """Open the blocks of a machine's new samples; trimmed: samples of their batch before them.

        MessageError names the first sample without credit; then nothing is opened. The sender gives up a sample that is
        refused alone, so the machine is there from then on, and what it drove since counts.
        """
        before, steps = self._accounts.get(machine) or Account(self.most), np.empty((len(rows), 2))
        used, has_jumped = survey(rows, self._limits, before[2:], steps, self._entered)
        if used > len(self._entered):
            self._entered = np.empty((used, 2), np.int64)
            survey(rows, self._limits, before[2:], steps, self._entered)
        credit, counted_m, new = before[:2], 0.0, set[int]()
        for key, row in self._entered[:used].tolist():
            if key in self.opened or key in new:
                continue
            until_m, by_jump = steps[row].tolist()
            jumps, driven = self._earned(credit, until_m - counted_m)
            pays = not by_jump and driven >= 1
            credit, counted_m = (jumps - (not pays), driven - pays), until_m
            if credit[0] < 0:
                if len(rows) == 1:
                    self._move(machine, rows, self._earned(before[:2], until_m), has_jumped=bool(by_jump))
                problem = f"{rows['x_m'][row]:.0f}, {rows['y_m'][row]:.0f} m is new ground, and the machine has not"
                problem += " driven far enough to open more: look at its positions"
                raise MessageError(Refusal.SCATTERED, problem, field="x_m", row=row + trimmed)
            new.add(key)
        credit = self._earned(credit, steps.item(len(rows) - 1, 0) - counted_m)
        self._move(machine, rows, credit, has_jumped=has_jumped)
        self.opened |= new

    def _earned(self, credit: tuple[float, float], driven_m: float) -> tuple[float, float]:
        jumps, driven = credit
        return min(jumps + self.jumps_per_m * driven_m, self.most), min(driven + self.per_m * driven_m, self.most)

    def _move(self, machine: str, rows: Table, credit: tuple[float, float], *, has_jumped: bool) -> None:
        self._accounts[machine] = Account(*credit, rows["x_m"].item(-1), rows["y_m"].item(-1), has_jumped)


def warm_up(config: FoldConfig) -> None:
    """Compile the kernel, or read it from its cache, before a batch waits for it."""
    BlockCredit(1.0, config, ()).spend("", empty(1))
