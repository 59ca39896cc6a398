"""SQLite connections that fail at a chosen statement, as the disk or the process under them would."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from agents.delivery.spool import Spool
from agents.delivery.spool_file import connect


class Killed(BaseException):
    """The process ends here: nothing of it runs on, least of all an `except Exception`."""


class Fault(StrEnum):
    """What happens at a statement."""

    KILLED_BEFORE = "killed_before"
    KILLED_AFTER = "killed_after"
    FULL = "full"  # the statement fails, its transaction stays open
    FULL_ROLLED_BACK = "full_rolled_back"  # as SQLite itself does after some errors


KILLS = (Fault.KILLED_BEFORE, Fault.KILLED_AFTER)


@dataclass
class FaultPlan:
    """The fault that comes at the `left`-th writing statement from now, if any; and whether the process has ended."""

    fault: Fault | None = None
    left: int = 0
    killed: bool = False

    def arm(self, fault: Fault, left: int) -> None:
        """Choose the next fault."""
        self.fault, self.left = fault, left

    def disarm(self) -> None:
        """Have no fault."""
        self.fault = None

    def due(self, statement: str) -> Fault | None:
        """Return the fault of this statement."""
        if self.killed:
            raise Killed
        if self.fault is None or statement.lstrip().startswith(("SELECT", "PRAGMA")):
            return None
        self.left -= 1
        if self.left > 0:
            return None
        fault, self.fault = self.fault, None
        self.killed = fault in KILLS
        return fault


class FaultyConnection(sqlite3.Connection):
    """Fails by its plan."""

    plan: FaultPlan | None = None

    def execute(self, statement: str, *values: Any) -> sqlite3.Cursor:
        """As sqlite3, or the fault."""
        self._before(fault := self._due(statement))
        cursor = super().execute(statement, *values)
        self._after(fault)
        return cursor

    def executemany(self, statement: str, *values: Any) -> sqlite3.Cursor:
        """As sqlite3, or the fault."""
        self._before(fault := self._due(statement))
        cursor = super().executemany(statement, *values)
        self._after(fault)
        return cursor

    def _due(self, statement: str) -> Fault | None:
        return self.plan.due(statement) if self.plan else None

    def _before(self, fault: Fault | None) -> None:
        if fault == Fault.KILLED_BEFORE:
            raise Killed
        if fault == Fault.FULL_ROLLED_BACK and self.in_transaction:
            super().execute("ROLLBACK")
        if fault in (Fault.FULL, Fault.FULL_ROLLED_BACK):
            raise sqlite3.OperationalError("database or disk is full")

    def _after(self, fault: Fault | None) -> None:
        if fault == Fault.KILLED_AFTER:
            raise Killed


class FaultySpool(Spool):
    """A spool whose process can be killed, and whose disk can be full, at any statement."""

    plan: FaultPlan

    def __init__(self, path: Path, plan: FaultPlan, **options: Any) -> None:
        self.plan = plan
        super().__init__(path, **options)

    def kill(self) -> None:
        """End the process that has the file open, as it is."""
        self.plan.killed = True
        self._db.close()

    def _connect(self, path: Path) -> sqlite3.Connection:
        db = connect(path, FaultyConnection)
        assert isinstance(db, FaultyConnection)
        db.execute("PRAGMA wal_autocheckpoint=0")  # files that are copied and thrown away: no need for it
        db.plan = self.plan
        return db
