"""Fault rates of a world, and SQLite connections that fail at a chosen statement, like a disk or process."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from agents.delivery.spool import Spool
from agents.delivery.spool_file import connect


class Killed(BaseException):
    """The process ends here; not caught by `except Exception`."""


class Fault(StrEnum):
    """Event at a statement."""

    KILLED_BEFORE = "killed_before"
    KILLED_AFTER = "killed_after"
    FULL = "full"  # fails, transaction stays open
    FULL_ROLLED_BACK = "full_rolled_back"  # as SQLite does after some errors


KILLS = (Fault.KILLED_BEFORE, Fault.KILLED_AFTER)


@dataclass
class FaultPlan:
    """The fault at the `left`-th writing statement from now, and whether the process ended."""

    fault: Fault | None = None
    left: int = 0
    killed: bool = False
    struck: bool = False  # since armed

    def arm(self, fault: Fault, left: int) -> None:
        self.fault, self.left = fault, left

    def disarm(self) -> None:
        self.fault, self.struck = None, False

    def due(self, statement: str) -> Fault | None:
        if self.killed:
            raise Killed
        if self.fault is None or statement.lstrip().startswith(("SELECT", "PRAGMA")):
            return None
        self.left -= 1
        if self.left > 0:
            return None
        fault, self.fault, self.struck = self.fault, None, True
        self.killed = fault in KILLS
        return fault


class FaultyConnection(sqlite3.Connection):
    plan: FaultPlan | None = None

    def execute(self, statement: str, *values: Any) -> sqlite3.Cursor:
        with self._fault_of(statement):
            return super().execute(statement, *values)

    def executemany(self, statement: str, *values: Any) -> sqlite3.Cursor:
        with self._fault_of(statement):
            return super().executemany(statement, *values)

    @contextmanager
    def _fault_of(self, statement: str) -> Iterator[None]:
        fault = self.plan.due(statement) if self.plan else None
        if fault == Fault.KILLED_BEFORE:
            raise Killed
        if fault == Fault.FULL_ROLLED_BACK and self.in_transaction:
            super().execute("ROLLBACK")
        if fault in (Fault.FULL, Fault.FULL_ROLLED_BACK):
            raise sqlite3.OperationalError("database or disk is full")
        yield
        if fault == Fault.KILLED_AFTER:
            raise Killed


class FaultySpool(Spool):
    """A spool whose process and disk can fail at any statement."""

    plan: FaultPlan

    def __init__(self, path: Path, plan: FaultPlan, **options: Any) -> None:
        self.plan = plan
        super().__init__(path, **options)

    def kill(self) -> None:
        """Kill the process that has the file open."""
        self.plan.killed = True
        self._db.close()
        self._mark.close()

    def _connect(self, path: Path) -> sqlite3.Connection:
        db = connect(path, FaultyConnection)
        assert isinstance(db, FaultyConnection)
        db.execute("PRAGMA wal_autocheckpoint=0")  # the files are temporary
        db.plan = self.plan
        return db


@dataclass(frozen=True)
class Rates:
    """Rate of each fault, and the kind of site, from the seed."""

    lost: float
    late: float
    twice: float
    reply_lost: float
    server_fault: float
    spool_fault: float
    bad_sample: float
    pending: bool
    copies: bool
    server_backups: bool
    max_samples: int
    wall_clock: bool
    machines: int
    steps: int


def draw_rates(rng: random.Random) -> Rates:
    """Every fault is absent in some worlds, so that others occur alone."""

    def some(most: float) -> float:
        return rng.choice((0.0, rng.uniform(0, most)))

    return Rates(
        lost=some(0.5),
        late=some(0.5),
        twice=some(0.4),
        reply_lost=some(0.5),
        server_fault=some(0.4),
        spool_fault=some(0.4),
        bad_sample=some(0.15),
        pending=rng.random() < 0.6,
        copies=rng.random() < 0.5,
        server_backups=rng.random() < 0.3,
        max_samples=rng.choice((10_000, 10_000, 20, 6)),
        wall_clock=rng.random() < 0.2,
        machines=rng.choice((1, 1, 2)),
        steps=rng.randint(20, 80),
    )
