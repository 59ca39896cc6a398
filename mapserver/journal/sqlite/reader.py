"""Tables and queries of a journal in SQLite, for its owner and other readers."""

from __future__ import annotations

import math
import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

from mapserver.journal.journal import ROWS_AT_ONCE, JournalState
from mapserver.journal.rows import Selection
from mapserver.journal.table_queries import BYTES_AT_ONCE, TableQueries, size_of
from protocol.errors import StoreError
from protocol.files import make_private

SCHEMA = 8
TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, crc32 INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE journal (
    row INTEGER PRIMARY KEY AUTOINCREMENT,
    record BLOB NOT NULL
);
CREATE TABLE watermark (
    machine TEXT NOT NULL, spool_id BLOB NOT NULL,
    seq INTEGER NOT NULL, lost INTEGER NOT NULL, newest_ns INTEGER NOT NULL, crc32 INTEGER NOT NULL,
    PRIMARY KEY (machine, spool_id)
) WITHOUT ROWID;
CREATE TABLE extent (
    row INTEGER PRIMARY KEY,
    first_stamp_ns INTEGER NOT NULL, last_stamp_ns INTEGER NOT NULL,
    west_m REAL NOT NULL, south_m REAL NOT NULL, east_m REAL NOT NULL, north_m REAL NOT NULL,
    crc32 INTEGER NOT NULL
);
CREATE TABLE events (
    id INTEGER PRIMARY KEY,
    kind TEXT NOT NULL, stamp_ns INTEGER NOT NULL, body TEXT NOT NULL, crc32 INTEGER NOT NULL
);
"""
_READ_ALL = "SELECT row, record FROM journal WHERE row > :after AND row <= :until ORDER BY row"
# LEFT JOIN reads extents first, and shows missing rows.
_READ_SOME = """SELECT row, record FROM extent LEFT JOIN journal USING (row)
WHERE extent.last_stamp_ns >= :from_ns AND extent.first_stamp_ns <= :to_ns
    AND west_m <= :east_m AND east_m >= :west_m AND south_m <= :north_m AND north_m >= :south_m
    AND row > :after AND row <= :until ORDER BY row"""
_LOOK_S = 0.02  # polling interval; a look costs 10 us
_EVERYWHERE = {"west_m": -math.inf, "south_m": -math.inf, "east_m": math.inf, "north_m": math.inf}


class SqliteQueries(TableQueries):
    """Queries on the owner's or a reader's connection; see `JournalQueries`."""

    schema, replica = SCHEMA, "none"
    path: Path
    _db: sqlite3.Connection

    @property
    def where(self) -> str:
        """The file."""
        return str(self.path)

    @property
    def last_row(self) -> int:
        """See `JournalQueries`; valid even if all rows are archived."""
        return self._number("SELECT COALESCE(MAX(seq), 0) FROM sqlite_sequence WHERE name = 'journal'")

    @property
    def archived_row(self) -> int:
        """See `JournalQueries`."""
        return self._meta_number("archived_row")

    def state(self) -> JournalState:
        """See `JournalQueries`."""
        return JournalState(self._meta_number("epoch"), self.last_row, self._last_event())

    def _last_event(self) -> int:
        return self._meta_number("event")  # not the greatest event, because later ones may be lost

    def _meta_number(self, key: str) -> int:
        return self._number(f"SELECT COALESCE(MAX(value), '0') FROM meta WHERE key = '{key}'")  # noqa: S608 # a constant

    @contextmanager
    def _one_state(self) -> Iterator[None]:
        self._query("BEGIN")
        try:
            yield
        finally:
            if self._db.in_transaction:  # SQLite ends it on disk errors
                self._db.execute("ROLLBACK")

    def _query(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(self.path, f"cannot be read: {error}") from None

    def _piece(self, after: int, until: int, selection: Selection) -> tuple[list[int], list[Any], bool]:
        """See `TableQueries`."""
        span: dict[str, float] = {"after": after, "until": until}
        if selection.everywhere:
            query, values = _READ_ALL, span
        else:
            box = asdict(selection.bounds) if selection.bounds else _EVERYWHERE
            query, values = _READ_SOME, {**span, **box, "from_ns": selection.from_ns, "to_ns": selection.to_ns}
        numbers: list[int] = []
        records: list[Any] = []
        size = 0
        try:
            cursor = self._db.execute(query, values)
            while size < BYTES_AT_ONCE and (part := cursor.fetchmany(ROWS_AT_ONCE)):
                more, some = zip(*part, strict=True)
                numbers += more
                records += some
                size += size_of(some)
            cursor.close()  # ends the transaction
        except sqlite3.Error as error:
            raise StoreError(self.path, f"cannot be read: {error}") from None
        return numbers, records, size < BYTES_AT_ONCE


class SqliteReader(SqliteQueries):
    """A read-only connection for other threads, while a server may write; see `JournalReader`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with ExitStack() as opened:
            try:
                self._db = sqlite3.connect(
                    f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None, check_same_thread=False
                )
                opened.callback(self._db.close)
                meta = self._meta()
            except sqlite3.Error as error:
                raise StoreError(path, f"is no usable journal: {error}") from None
            self.site, self.frame = meta.get("site", ""), meta.get("frame", "")
            opened.pop_all()

    is_replica = False

    def complete_s(self) -> float:
        """See `JournalReader`."""
        return time.monotonic()

    def follow(self, known: JournalState, timeout_s: float) -> JournalState:
        """See `JournalReader`; by polling, because SQLite does not notify."""
        end_s, state, version = time.monotonic() + timeout_s, self.state(), self._version()
        while state == known and time.monotonic() < end_s:
            time.sleep(_LOOK_S)
            if (newer := self._version()) != version:
                state, version = self.state(), newer
        return state

    def copy_to(self, path: Path) -> None:
        """Copy one committed state into a new file, while a server may write; StoreError."""
        try:
            make_private(path)
            with closing(sqlite3.connect(path)) as copy:
                self._db.backup(copy)  # in one step, while a writer continues in the log
                copy.execute("PRAGMA synchronous=FULL")
                copy.execute("PRAGMA journal_mode=DELETE")  # makes the copy a single file
            with path.open("rb") as file:
                os.fsync(file.fileno())
        except (sqlite3.Error, OSError) as error:
            raise StoreError(path, f"cannot be written: {error}") from None

    def require_sound(self) -> None:
        """StoreError if SQLite finds damage; `check` and row reads find the rest."""
        ((verdict,), *_) = self._query("PRAGMA integrity_check(1)")
        if verdict != "ok":
            raise self._damaged(f"the file ({verdict})")

    def _version(self) -> int:
        """Changes when a server commits."""
        return self._number("PRAGMA data_version")

    def close(self) -> None:
        """Close the connection."""
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
