"""The spool's file: tables, opening, transactions, and its mark: last recorded and acknowledged seq of each run."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from protocol.files import make_private

SCHEMA = 9
LOCK_WAIT_S = 1.0  # wait for a predecessor that is still closing the file
_TABLES = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE run (base INTEGER PRIMARY KEY, spool_id TEXT, acknowledged INT, closed INT, store TEXT, crc32 INT)",
    "CREATE TABLE sample (number INTEGER PRIMARY KEY, row BLOB NOT NULL, crc32 INTEGER)",
    "CREATE TABLE quarantine (spool_id TEXT NOT NULL, seq INTEGER NOT NULL, row BLOB NOT NULL, problem TEXT NOT NULL)",
    "INSERT INTO meta VALUES ('newest', '0'), ('dropped', '0'), ('recorded', '0'), ('gone', '0')",
    f"PRAGMA user_version={SCHEMA}",
)
_ACKNOWLEDGED = " acknowledged"


def connect(path: Path, kind: type[sqlite3.Connection] = sqlite3.Connection) -> sqlite3.Connection:
    """Open a file exclusively: two agents on one file would send a sample twice, or not at all."""
    make_private(path)
    db = sqlite3.connect(path, LOCK_WAIT_S, isolation_level=None, check_same_thread=False, factory=kind)
    db.execute("PRAGMA locking_mode=EXCLUSIVE")
    return db


def make_or_check(db: sqlite3.Connection) -> None:
    """Create missing tables; ValueError for another schema."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone():
        for statement in _TABLES:
            db.execute(statement)
    require_schema(db)


def require_schema(db: sqlite3.Connection) -> None:
    """ValueError for a file of another version, which says what to do."""
    (schema,) = db.execute("PRAGMA user_version").fetchone()
    if schema != SCHEMA:
        advice = "have the version that wrote it send its samples, or choose another --spool"
        raise ValueError(f"schema {schema}, this version knows {SCHEMA}; {advice}")


def run_ends_in(db: sqlite3.Connection) -> list[RunEnd]:
    """Runs of a file at rest that have or had samples."""
    (newest,) = db.execute("SELECT value FROM meta WHERE key = 'newest'").fetchone()
    runs = db.execute("SELECT base, spool_id, acknowledged FROM run ORDER BY base").fetchall()
    ends = [*(base for base, _, _ in runs[1:]), int(newest)]
    each = zip(runs, ends, strict=True)
    return [RunEnd(int(name, 16), end - base, acked) for (base, name, acked), end in each if end > base]


def checksum(number: int, row: bytes) -> int:
    """CRC-32 of a sample, seeded with its number."""
    return zlib.crc32(row, number & 0xFFFFFFFF)


def checksum_of(*values: object) -> int:
    """CRC-32 of plain values."""
    return zlib.crc32(repr(values).encode())


def why_unusable(error: Exception) -> str:
    """Say why a file cannot be used."""
    if "locked" in str(error):
        return "another agent is using this spool; stop it, or choose another --spool"
    return f"is no usable spool: {error}"


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """All or nothing, also if the commit fails."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    finally:
        if db.in_transaction:  # SQLite itself rolls back after some disk errors
            db.execute("ROLLBACK")


@dataclass(frozen=True)
class RunEnd:
    """Last recorded and acknowledged seq of a run."""

    spool_id: int
    recorded: int
    acknowledged: int

    def values(self) -> dict[str, int]:
        """Entries of the mark."""
        name = f"{self.spool_id:016x}"
        return {name: self.recorded, name + _ACKNOWLEDGED: self.acknowledged}


def run_ends(mark: Mapping[str, int]) -> list[RunEnd]:
    """Undo `RunEnd.values`, in order of the runs' start."""
    names = [name for name in mark if not name.endswith(_ACKNOWLEDGED)]
    return [RunEnd(int(name, 16), mark[name], mark.get(name + _ACKNOWLEDGED, 0)) for name in names]


def runs_cut_short(there: Iterable[RunEnd], mark: Mapping[str, int]) -> list[tuple[RunEnd, int]]:
    """Runs that the mark takes further than the file, each with its lost, unacknowledged samples.

    there: the file's runs in order; only the last can be short.
    """
    *earlier, last = [*there] or [RunEnd(0, 0, 0)]
    known = {run.spool_id for run in earlier}
    short = []
    for end in run_ends(mark):
        kept = last.recorded if end.spool_id == last.spool_id else 0
        if end.spool_id not in known and end.recorded > kept:
            short.append((end, max(0, end.recorded - max(kept, end.acknowledged))))
    return short
