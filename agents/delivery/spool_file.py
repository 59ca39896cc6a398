"""The spool's file: its tables, how it is opened, and transactions that leave nothing half done."""

from __future__ import annotations

import sqlite3
import zlib
from pathlib import Path

SCHEMA = 2
LOCK_WAIT_S = 1.0  # for a predecessor that is still closing the file
_RUN = "CREATE TABLE run (base INTEGER PRIMARY KEY, spool_id TEXT, acknowledged INTEGER, closed INTEGER, crc32 INTEGER)"
_TABLES = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE sample (number INTEGER PRIMARY KEY, row BLOB NOT NULL, final INTEGER NOT NULL, crc32 INTEGER)",
    "CREATE TABLE aside (spool_id TEXT NOT NULL, seq INTEGER NOT NULL, row BLOB NOT NULL, problem TEXT NOT NULL)",
    "INSERT INTO meta VALUES ('newest', '0'), ('dropped', '0'), ('recorded', '0')",
    _RUN,
    f"PRAGMA user_version={SCHEMA}",
)
_FROM_SCHEMA_1 = (
    _RUN,
    "INSERT INTO run SELECT 0, value, 0, 0, NULL FROM meta WHERE key = 'spool_id'",
    "UPDATE run SET acknowledged = (SELECT value FROM meta WHERE key = 'acknowledged')",
    "DELETE FROM meta WHERE key IN ('spool_id', 'acknowledged')",
    "ALTER TABLE sample RENAME COLUMN seq TO number",
    "ALTER TABLE sample ADD COLUMN crc32 INTEGER",
    "INSERT INTO meta SELECT 'plain_until', value FROM meta WHERE key = 'newest'",  # up to there it is not known
    f"PRAGMA user_version={SCHEMA}",
)


def connect(path: Path, kind: type[sqlite3.Connection] = sqlite3.Connection) -> sqlite3.Connection:
    """Open a file for this process alone: two agents on one file would send one sample twice, or not at all."""
    db = sqlite3.connect(path, LOCK_WAIT_S, isolation_level=None, check_same_thread=False, factory=kind)
    db.execute("PRAGMA locking_mode=EXCLUSIVE")
    return db


def make_or_check(db: sqlite3.Connection) -> None:
    """Write the tables of a new file, bring an older one up to date; ValueError for any other schema."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone():
        _run_all(db, _TABLES)
    elif _schema(db) == 1:
        _run_all(db, _FROM_SCHEMA_1)
    if (schema := _schema(db)) != SCHEMA:
        raise ValueError(f"schema {schema}, this agent knows {SCHEMA}")


def checksum(number: int, row: bytes) -> int:
    """CRC-32 of a sample and its place."""
    return zlib.crc32(row, number & 0xFFFFFFFF)


def checksum_of(*values: object) -> int:
    """CRC-32 of plain values."""
    return zlib.crc32(repr(values).encode())


def why_unusable(error: Exception) -> str:
    """Say why a file cannot be used."""
    if "locked" in str(error):
        return "another agent is using this spool; stop it, or choose another --spool"
    return f"is no usable spool: {error}"


class transaction:  # noqa: N801 - used like a keyword
    """All or nothing; an error rolls back and goes on up, also one of the commit itself."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if not kind:
                self._db.execute("COMMIT")
        finally:
            if self._db.in_transaction:  # SQLite itself has rolled back after some errors of the disk
                self._db.execute("ROLLBACK")


def _run_all(db: sqlite3.Connection, statements: tuple[str, ...]) -> None:
    for statement in statements:
        db.execute(statement)


def _schema(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])
