"""Credit for ground: a machine may open as much map as it has driven for. No files, no clock.

A block costs memory for the map's life. One sample of 80 bytes opens up to four: scattered, each costs 7 kB; on open
ground each adds a page per bucket. Refused samples are not journalled, so the map stays a function of the journal.
Credit is lost on restart, but who is in the journal then is no newcomer (docs/decisions/0011-credit-for-new-ground.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.fold_kernels import BUCKET_BITS
from mapserver.evidence.sample_kernels import SIGMAS, block_key, survey
from mapserver.evidence.timeline import Block
from protocol.arrays import Table
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import empty
from protocol.site.geometry import BLOCK_CELLS

JUMPS = 50  # jumps to new ground, of the blocks a sample can open: 200 with 1 m cells
JUMP_M = 200.0  # metres driven per further jump
PAGES, FIRST_PAGES = 4000.0, 500.0  # opened blocks, of up to 11 kB: at most, and for a new machine
STAY_S = 30.0  # server seconds that earn a sample's pages; standing costs one bucket in 300 s
# share of newcomers' credit that the next one lacks, regained per minute; without keys, names are free
NEWCOMER = 1 / 64
MOST_ACCOUNTS = 4096
MOST_PAIRS = 2048  # remembered blocks times buckets; 300 s at 25 m/s on new ground enter 1400


class Credit(NamedTuple):
    """Blocks a machine may enter: by jumps, by driving; pages: on opened ground."""

    jumps: float
    driven: float
    pages: float


@dataclass(frozen=True)
class Account:
    """A machine's credit, position, and entered blocks by bucket. seen_ns: server time of its last batch."""

    credit: Credit
    seen_ns: int
    x_m: float = math.nan
    y_m: float = math.nan
    has_jumped: bool = True
    stamp_ns: int = 0
    entered: set[int] = field(default_factory=set)


class BlockCredit:
    """The accounts of all machines. opened: keys of open blocks.

    most: limit of jumps and driven [blocks]. per_m, jumps_per_m: earned per metre. journalled: machines of the
    journal, no newcomers, once each. signed: names are not free, so newcomers have full credit.
    """

    def __init__(
        self,
        cell_m: float,
        config: FoldConfig,
        opened: Iterable[Block],
        journalled: Iterable[str] = (),
        *,
        signed: bool = False,
    ) -> None:
        self.opened, self._accounts = {block_key(*block) for block in opened}, dict[str, Account]()
        self._limits, self._entered = (cell_m, STD_FLOOR_M**2, config.std_cap_m**2), np.empty((1, 2), np.int64)
        # New ground is met by a moving square, as wide as votes plus position errors on both sides; at 45 degrees it
        # meets sqrt(2) times as many blocks.
        std = math.hypot(config.std_cap_m, STD_FLOOR_M) / cell_m
        edge = 2 * math.ceil(2 * std) + 1
        swept = BLOCK_CELLS + edge - 1 + 2 * SIGMAS * std
        self.per_m = math.sqrt(2) * swept / (BLOCK_CELLS**2 * cell_m)
        blocks = (2 + (edge - 2) // BLOCK_CELLS) ** 2
        self.most, self.jumps_per_m = float(JUMPS * blocks), blocks / JUMP_M
        self._bucket_ns, self._blocks = config.bucket_ns, blocks
        self._newcomers, self._newcomer_ns = 1.0, 0
        self._journalled, self._signed = set(journalled), signed

    def spend(self, machine: str, rows: Table, trimmed: int = 0, now_ns: int = 0) -> None:
        """Open the blocks of a machine's new samples; trimmed: samples of the batch before them.

        now_ns: server time. MessageError names the first sample without credit; nothing is opened then. Senders drop a
        sample refused alone, so its position and metres count.
        """
        before, steps = self._account(machine, now_ns), np.empty((len(rows), 2))
        place = (before.x_m, before.y_m, before.has_jumped, before.stamp_ns)
        used, has_jumped = survey(rows, self._limits, self._bucket_ns, place, steps, self._entered)
        if used > len(self._entered):
            self._entered = np.empty((used, 2), np.int64)
            survey(rows, self._limits, self._bucket_ns, place, steps, self._entered)
        keys, numbers = self._entered[:used].T
        pairs = keys << BUCKET_BITS | rows["stamp_ns"][numbers] // self._bucket_ns % 2**BUCKET_BITS
        counted_m, new, entered, known = 0.0, set[int](), set[int](), before.entered
        jumps, driven, pages = before.credit
        driven_at = steps.tolist()
        for key, row, pair in zip(keys.tolist(), numbers.tolist(), pairs.tolist(), strict=True):
            if pair in entered or pair in known:
                continue
            until_m, by_jump = driven_at[row]
            if until_m > counted_m:
                jumps, driven, pages = self._earned(Credit(jumps, driven, pages), until_m - counted_m)
                counted_m = until_m
            if not by_jump and driven >= 1:
                driven -= 1
            elif key in self.opened or key in new:
                pages -= 1
            else:
                jumps -= 1
            if jumps < 0 or pages < 0:
                if len(rows) == 1:
                    left = replace(before, credit=self._earned(before.credit, until_m))
                    self._move(machine, left, rows, has_jumped=bool(by_jump))
                problem = f"{rows['x_m'][row]:.0f}, {rows['y_m'][row]:.0f} m is ground for which the machine has not"
                problem += " driven far enough: look at its positions"
                raise MessageError(Refusal.SCATTERED, problem, field="x_m", row=row + trimmed)
            new.add(key)
            entered.add(pair)
        if len(known) > MOST_PAIRS:
            known.clear()
        known |= entered
        credit = self._earned(Credit(jumps, driven, pages), driven_at[-1][0] - counted_m)
        self._move(machine, replace(before, credit=credit, entered=known), rows, has_jumped=has_jumped)
        self.opened |= new

    def _account(self, machine: str, now_ns: int) -> Account:
        """The machine's account, with what time has earned."""
        known = self._accounts.pop(machine, None)
        if known is None:
            share = 1.0 if self._signed or machine in self._journalled else self._newcomer_share(now_ns)
            self._journalled.discard(machine)
            credit = Credit(self.most * share, 0.0, FIRST_PAGES * share)
            if len(self._accounts) >= MOST_ACCOUNTS:
                del self._accounts[next(iter(self._accounts))]
            known = Account(credit, now_ns)
        stayed = self._blocks * max(0, now_ns - known.seen_ns) / (1e9 * STAY_S)
        credit = known.credit._replace(pages=min(known.credit.pages + stayed, PAGES))
        self._accounts[machine] = account = replace(known, credit=credit, seen_ns=max(now_ns, known.seen_ns))
        return account

    def _newcomer_share(self, now_ns: int) -> float:
        """Share of a full credit for the next newcomer."""
        share = min(1.0, self._newcomers + NEWCOMER * max(0, now_ns - self._newcomer_ns) / 60e9)
        self._newcomers, self._newcomer_ns = share - NEWCOMER * share, now_ns
        return share

    def _earned(self, credit: Credit, driven_m: float) -> Credit:
        by_jumps = self.jumps_per_m * driven_m
        jumps, driven = min(credit.jumps + by_jumps, self.most), min(credit.driven + self.per_m * driven_m, self.most)
        return Credit(jumps, driven, min(credit.pages + by_jumps, PAGES))

    def _move(self, machine: str, account: Account, rows: Table, *, has_jumped: bool) -> None:
        x_m, y_m, stamp_ns = (rows[name].item(-1) for name in ("x_m", "y_m", "stamp_ns"))
        self._accounts[machine] = replace(account, x_m=x_m, y_m=y_m, stamp_ns=stamp_ns, has_jumped=has_jumped)


def warm_up(config: FoldConfig) -> None:
    """Compile the kernel, or load it, before a batch waits for it."""
    BlockCredit(1.0, config, ()).spend("", empty(1))
