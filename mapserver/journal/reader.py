"""The tables of a journal, and what can be read of them, by its owner as by any other thread or process."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from mapserver.journal.records import decoded
from mapserver.journal.rows import (
    ALL,
    Event,
    JournalRow,
    JournalRows,
    Selection,
    StoreIdentity,
    Watermark,
    checksum,
    extent_checksum,
)
from protocol.errors import StoreError

SCHEMA = 6  # the only one: a journal of another one is refused
# When and where the samples of a row lie is a table of its own: 50 bytes a row, so that a read by time and place passes
# over rows without touching the pages of their payloads. Such a read cannot see that it misses a row where a bit of its
# extent has flipped; so extents have a checksum of their own, which is checked on opening.
TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
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
# LEFT JOIN keeps SQLite from walking the journal first, and shows a row that is not there.
_READ_SOME = """SELECT row, record FROM extent LEFT JOIN journal USING (row)
WHERE extent.last_stamp_ns >= :from_ns AND extent.first_stamp_ns <= :to_ns
    AND west_m <= :east_m AND east_m >= :west_m AND south_m <= :north_m AND north_m >= :south_m
    AND row > :after AND row <= :until ORDER BY row"""
# Read or removed in one transaction: short ones keep the write-ahead log small.
ROWS_AT_ONCE = 200
BYTES_AT_ONCE = 2**20  # or the rows that pass it; what is read of them stays in the processor's cache
_EXTENTS_AT_ONCE = 10_000
LAST = 2**63 - 1
_EVERYWHERE = {"west_m": -math.inf, "south_m": -math.inf, "east_m": math.inf, "north_m": math.inf}


class ArchivedError(StoreError):
    """Rows that are asked for have moved to the archive. archived_row: the last one that has."""

    def __init__(self, path: Path, archived_row: int) -> None:
        super().__init__(path, f"rows up to {archived_row} are in the archive beside it")
        self.archived_row = archived_row


def _dense(numbers: Sequence[int], after: int) -> int:
    """How many of the first numbers follow each other, from `after` on."""
    gaps = np.flatnonzero(np.array(numbers, np.int64) != np.arange(after + 1, after + 1 + len(numbers)))
    return int(gaps[0]) if len(gaps) else len(numbers)


def _size(records: Sequence[Any]) -> int:
    try:
        return sum(map(len, records))
    except TypeError:  # damage has turned one into a number
        return BYTES_AT_ONCE


class JournalQueries:
    """What can be read of a journal, on its owner's connection as on a reader's."""

    path: Path
    _db: sqlite3.Connection

    def read(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRow]:
        """As `read_many`, one by one."""
        return chain.from_iterable(self.read_many(after, until, selection))

    def read_many(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRows]:
        """Rows after < row <= until in order, also those that are committed meanwhile; many at a time, and never none.

        StoreError where a row is missing or not what was written, after those before it; ArchivedError as soon as one
        of them is archived.
        """
        while True:
            last = min(until, self._last_row())  # asked before the rows are read: all up to this one must be there
            numbers, records, is_end = self._piece(after, until, selection)
            # Asked after the rows were read: none beyond this one had been removed then.
            if after < min(archived := self.archived_row, until):
                raise ArchivedError(self.path, archived)
            there = _dense(numbers, after) if selection.everywhere else len(numbers)
            rows = decoded(numbers[:there], records[:there])
            if len(others := rows.without(selection.without)):
                yield others
            if (n := len(rows)) < there:
                raise self._damaged(f"journal row {numbers[n]}")
            after = numbers[n - 1] if n else after
            if n < len(numbers) or (is_end and selection.everywhere and after < last):
                raise self._damaged(f"what follows number {after}")
            if is_end:
                return

    def stamps_by_chunk(self, after: int, until: int, chunk: int) -> list[tuple[int, int, int]]:
        """Chunks of so many rows among after < row <= until: number, least and greatest stamp of each."""
        query = "SELECT (row - 1) / ?, MIN(first_stamp_ns), MAX(last_stamp_ns) FROM extent"
        return self._query(f"{query} WHERE row > ? AND row <= ? GROUP BY 1", (chunk, after, until))

    def least_stamp(self, after: int, until: int, from_ns: int) -> int | None:
        """The least stamp of rows after < row <= until, `from_ns` of a row that reaches across it; None for none."""
        query = "SELECT MIN(MAX(first_stamp_ns, ?)) FROM extent WHERE last_stamp_ns >= ? AND row > ? AND row <= ?"
        ((stamp,),) = self._query(query, (from_ns, from_ns, after, until))
        return None if stamp is None else int(stamp)

    def rows_before(self, after: int, until: int, stamp_ns: int) -> int:
        """How many of the rows after < row <= until have a stamp before a time; of archived ones none is counted."""
        query = "SELECT COUNT(*) FROM extent WHERE first_stamp_ns < ? AND row > ? AND row <= ?"
        ((count,),) = self._query(query, (stamp_ns, after, until))
        return int(count)

    def identity(self) -> StoreIdentity:
        """Which store this is; StoreError where that is damaged."""
        words = self._meta().get("store", "").split()
        if len(words) < 2 or words[-1] != f"{checksum(*words[:-1]):08x}":
            raise self._damaged("the id of the store")
        return StoreIdentity(words[0], tuple(words[1:-1]))

    @property
    def archived_row(self) -> int:
        """The last row that has moved to the archive."""
        return self._number("SELECT COALESCE(MAX(value), 0) FROM meta WHERE key = 'archived_row'")

    def events(self, kind: str | None = None, after: int = 0) -> list[Event]:
        """Events beyond the number `after`, of one kind or of all, in the order in which they were written."""
        query = (
            "SELECT id, kind, stamp_ns, body, crc32 FROM events WHERE id > ? AND kind = COALESCE(?, kind) ORDER BY id"
        )
        return [self._event(*values) for values in self._query(query, (after, kind))]

    def check(self) -> None:
        """Check identity, extents, events and watermarks; StoreError where one is damaged.

        Rows are checked when they are read. A damaged extent would hide its row from a read by time and place, without
        any error.
        """
        self._db.execute("BEGIN")  # one state for all of it, also while a server writes
        try:
            self.identity()
            self._require_each(self._extent_rows(), self.archived_row, self._last_row())
            self._require_each((event.id for event in self.events()), 0)
            self._load_watermarks()
        finally:
            if self._db.in_transaction:  # SQLite itself ends it where the disk fails
                self._db.execute("ROLLBACK")

    def _query(self, query: str, values: Sequence[Any] | Mapping[str, Any] = ()) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(self.path, f"cannot be read: {error}") from None

    def _meta(self) -> dict[str, str]:
        """All of the table meta; StoreError where the journal has another schema."""
        meta = dict(self._query("SELECT key, value FROM meta"))
        if meta.get("schema") != str(SCHEMA):
            problem = f"has schema {meta.get('schema')!r}, this version knows {SCHEMA}"
            raise StoreError(self.path, f"{problem}; open it with the version that wrote it, or choose another --store")
        return meta

    def _number(self, query: str) -> int:
        ((value,),) = self._query(query)
        try:
            return int(value)
        except ValueError:
            raise self._damaged(f"the value {value!r}") from None

    def _last_row(self) -> int:  # also where all rows are archived
        return self._number("SELECT COALESCE(MAX(seq), 0) FROM sqlite_sequence WHERE name = 'journal'")

    def _piece(self, after: int, until: int, selection: Selection) -> tuple[list[int], list[Any], bool]:
        """Numbers and records of the next rows, and whether there are no more."""
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
                size += _size(some)
            cursor.close()  # which ends the transaction
        except sqlite3.Error as error:
            raise StoreError(self.path, f"cannot be read: {error}") from None
        return numbers, records, size < BYTES_AT_ONCE

    def _require_each(self, numbers: Iterable[int], after: int, last: int = 0) -> None:
        """StoreError unless each number follows the one before, from `after` on, to `last` at least."""
        for number in numbers:
            if number != after + 1:
                raise self._damaged(f"what follows number {after}")
            after = number
        if after < last:
            raise self._damaged(f"what follows number {after}")

    def _damaged(self, what: str) -> StoreError:
        return StoreError(self.path, f"{what} is damaged; restore the file from a backup")

    def _extent_rows(self) -> Iterator[int]:
        """The rows that have an extent, in order; read in pieces, since there may be millions."""
        query, row = "SELECT * FROM extent WHERE row > ? ORDER BY row LIMIT ?", 0
        while piece := self._query(query, (row, _EXTENTS_AT_ONCE)):
            for *extent, crc32 in piece:
                row = extent[0]
                if crc32 != extent_checksum(*extent):
                    raise self._damaged(f"the extent of journal row {row}")
                yield row

    def _event(self, number: int, kind: str, stamp_ns: int, body: str, crc32: int) -> Event:
        if crc32 != checksum(number, kind, stamp_ns, body):
            raise self._damaged(f"event {number}")
        return Event(number, kind, stamp_ns, json.loads(body))

    def _load_watermarks(self) -> dict[tuple[str, int], Watermark]:
        watermarks = {}
        query = "SELECT machine, spool_id, seq, lost, newest_ns, crc32 FROM watermark"
        for machine, spool, *values, crc32 in self._query(query):
            if crc32 != checksum(machine, spool, *values):
                raise self._damaged(f"the watermark of {machine}")
            watermarks[machine, int.from_bytes(spool, "big")] = Watermark(*values)
        return watermarks


class JournalReader(JournalQueries):
    """A read-only connection for threads other than the owner's, also while a server writes; one thread at a time.

    site, frame: whose journal it is.
    """

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

    @property
    def last_row(self) -> int:
        """The last row on disk, archived or not."""
        return self._last_row()

    def watermarks(self) -> dict[tuple[str, int], Watermark]:
        """Progress of all spools."""
        return self._load_watermarks()

    def close(self) -> None:
        """Close the connection."""
        self._db.close()

    def __enter__(self) -> JournalReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
