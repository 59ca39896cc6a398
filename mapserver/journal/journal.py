"""The journal: what machines sent, in SQLite, committed with FULL sync before it is acknowledged. It is the truth.

One journal row is one admitted batch. Row and watermark are written in one transaction, so that exactly-once is
decided here. EVIDENCE: `synchronous=NORMAL` lost acknowledged rows in 398 of 400 simulated power cuts, FULL none.
Rows up to `archived_row` have moved to Parquet files (archive.py); past.py reads both as one.
"""

from __future__ import annotations

import json
import math
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mapserver.ingest.admission import Admission
from mapserver.journal.rows import ALL, Event, JournalRow, Mark, Wanted, checksum, extent_checksum, pack, unpack
from mapserver.journal.schema import EXTENT_VALUES, SCHEMA, SEEN, TABLES, UPGRADES
from protocol.errors import StoreError

# ruff: noqa: S608 - statements are put together from constants, never from input
_COLUMNS = "SELECT row, machine, spool_id, first_seq, received_ns, payload, journal.crc32 FROM "
_IN_ORDER = "AND row > :after AND row <= :until ORDER BY row LIMIT :most"
_READ_ALL = f"{_COLUMNS} journal WHERE TRUE {_IN_ORDER}"
# LEFT JOIN keeps SQLite from walking the journal first, and shows a row that is not there.
_READ_SOME = f"""{_COLUMNS} extent LEFT JOIN journal USING (row)
WHERE extent.last_stamp_ns >= :from_ns AND extent.first_stamp_ns <= :to_ns
    AND (west_m IS NULL OR west_m <= :east_m AND east_m >= :west_m AND south_m <= :north_m AND north_m >= :south_m)
{_IN_ORDER}"""
_WAL_LIMIT = 64 * 2**20
_AT_ONCE = 200  # rows that are read or removed in one transaction: short ones keep the write-ahead log small
_EXTENTS_AT_ONCE = 10_000
_PLAIN_UNTIL = "SELECT COALESCE(MAX(value), 0) FROM meta WHERE key = 'plain_until'"
LAST = 2**63 - 1
_EVERYWHERE = {"west_m": -math.inf, "south_m": -math.inf, "east_m": math.inf, "north_m": math.inf}
SPARE = 0.25  # share of free pages above which a file is made smaller


class ArchivedError(StoreError):
    """Rows that are asked for have moved to the archive. archived_row: the last one that has."""

    def __init__(self, path: Path, archived_row: int) -> None:
        super().__init__(path, f"rows up to {archived_row} are in the archive; read them together (past.history_rows)")
        self.archived_row = archived_row


class JournalReads:
    """What can be read of a journal, on its owner's connection as on a reader's."""

    path: Path
    _db: sqlite3.Connection
    _plain_until: int  # rows up to this one were written by schema 1, which had a checksum of the payload alone

    def read(self, after: int = 0, until: int = LAST, wanted: Wanted = ALL) -> Iterator[JournalRow]:
        """Rows after < row <= until in order, also those that are committed meanwhile.

        StoreError where a row is missing or not what was written; ArchivedError as soon as one of them is archived.
        """
        while True:
            last = min(until, self._last_row())  # asked before the rows are read: all up to this one must be there
            found = self._piece(after, until, wanted)
            # Asked after the rows were read: none beyond this one had been removed then.
            if after < min(archived := self.archived_row, until):
                raise ArchivedError(self.path, archived)
            is_end = len(found) < _AT_ONCE
            if wanted.everywhere:
                self._require_each((row for row, *_ in found), after, last if is_end else 0)
            yield from (self._row(*values) for values in found if values[1] not in wanted.without)
            if is_end:
                return
            after = found[-1][0]

    def newest_ns(self) -> int:
        """The newest stamp of all samples, archived or not: the site's now."""
        return self._number("SELECT COALESCE(MAX(newest_ns), 0) FROM watermark")

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
        """Look at what stands beside the rows, which are looked at when they are read: StoreError where it is damaged.

        A damaged extent would hide its row from whoever asks by time and place, without a word.
        """
        self._db.execute("BEGIN")  # one state for all of it, also while a server writes
        try:
            self._require_each(self._extent_rows(), self.archived_row, self._last_row())
            self._require_each((event.id for event in self.events()), 0)
            self._load_marks()
        finally:
            if self._db.in_transaction:  # SQLite itself ends it where the disk fails
                self._db.execute("ROLLBACK")

    def _query(self, query: str, values: Sequence[Any] | Mapping[str, Any] = ()) -> list[tuple[Any, ...]]:
        try:
            return self._db.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(self.path, f"cannot be read: {error}") from None

    def _meta(self) -> dict[str, str]:
        return dict(self._query("SELECT key, value FROM meta"))

    def _number(self, query: str) -> int:
        ((value,),) = self._query(query)
        try:
            return int(value)
        except ValueError:
            raise self._damaged(f"the value {value!r}") from None

    def _last_row(self) -> int:  # also where all rows are archived
        return self._number("SELECT COALESCE(MAX(seq), 0) FROM sqlite_sequence WHERE name = 'journal'")

    def _piece(self, after: int, until: int, wanted: Wanted) -> list[tuple[Any, ...]]:
        span = {"after": after, "until": until, "most": _AT_ONCE}
        if wanted.everywhere:
            return self._query(_READ_ALL, span)
        box = asdict(wanted.bounds) if wanted.bounds else _EVERYWHERE
        return self._query(_READ_SOME, {**span, **box, "from_ns": wanted.from_ns, "to_ns": wanted.to_ns})

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

    def _row(
        self, row: int, machine: str, spool: bytes, first_seq: int, received_ns: int, payload: bytes, crc32: int
    ) -> JournalRow:
        plain = row <= self._plain_until and isinstance(payload, bytes) and zlib.crc32(payload) == crc32
        if not plain and checksum(row, machine, spool, first_seq, received_ns, payload) != crc32:
            raise self._damaged(f"journal row {row}")
        return JournalRow(row, machine, int.from_bytes(spool, "big"), first_seq, unpack(payload), received_ns)

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

    def _load_marks(self) -> dict[tuple[str, int], Mark]:
        marks = {}
        query = "SELECT machine, spool_id, seq, lost, newest_ns, crc32 FROM watermark"
        for machine, spool, *values, crc32 in self._query(query):
            is_plain = crc32 is None and self._plain_until > 0
            if not is_plain and crc32 != checksum(machine, spool, *values):
                raise self._damaged(f"the watermark of {machine}")
            marks[machine, int.from_bytes(spool, "big")] = Mark(*values)
        return marks


class Journal(JournalReads):
    """One writer's connection to the journal of one site. StoreError where anything in it is damaged (`check`)."""

    last_row: int

    def __init__(self, path: Path, site: str, frame: str) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            try:
                self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
                opened.callback(self._db.close)
                _lend_checksums(self._db)
                self._db.execute("PRAGMA auto_vacuum=INCREMENTAL")  # only a new file takes it
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._db.execute(f"PRAGMA journal_size_limit={_WAL_LIMIT}")
                self._create_or_check(site, frame)
                self.check()
                self._return_to_disk()
            except sqlite3.Error as error:
                raise StoreError(path, f"is no usable journal: {error}") from None
            opened.pop_all()

    def mark(self, machine: str, spool_id: int) -> Mark:
        """Progress of a spool."""
        return self._marks.get((machine, spool_id), Mark())

    def marks(self) -> dict[tuple[str, int], Mark]:
        """Progress of all spools."""
        return dict(self._marks)

    def begin(self) -> None:
        """Open a transaction; rows appended from here on are one group commit."""
        self._db.execute("BEGIN IMMEDIATE")

    def append(self, admission: Admission, received_ns: int) -> int:
        """Write one row and its watermark into the open transaction; returns the row's number."""
        batch = admission.batch
        payload = pack(batch.rows)
        x_m, y_m, stamps = (batch.rows[name] for name in ("x_m", "y_m", "stamp_ns"))
        first_ns, last_ns = int(stamps.min()), int(stamps.max())
        spool = _spool_bytes(batch.spool_id)
        row = self.last_row + 1
        crc32 = checksum(row, batch.machine, spool, batch.first_seq, received_ns, payload)
        values = (row, batch.machine, spool, batch.first_seq, len(batch.rows), received_ns)
        self._db.execute(
            "INSERT INTO journal (row, machine, spool_id, first_seq, n, received_ns, first_stamp_ns, last_stamp_ns,"
            " payload, crc32) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*values, first_ns, last_ns, payload, crc32),
        )
        box = (float(x_m.min()), float(y_m.min()), float(x_m.max()), float(y_m.max()))
        extent = (row, first_ns, last_ns, *box)
        self._db.execute("INSERT INTO extent VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (*extent, extent_checksum(*extent)))
        before = self.mark(batch.machine, batch.spool_id)
        mark = Mark(admission.watermark, before.lost + admission.lost, max(before.newest_ns, last_ns))
        self.put_mark(batch.machine, batch.spool_id, mark)
        self.last_row = row
        return row

    def declare_lost(self, admission: Admission) -> None:
        """Write a watermark alone into the open transaction: samples at a spool's end that will never come."""
        batch = admission.batch
        before = self.mark(batch.machine, batch.spool_id)
        self.put_mark(
            batch.machine, batch.spool_id, replace(before, seq=admission.watermark, lost=before.lost + admission.lost)
        )

    def put_mark(self, machine: str, spool_id: int, mark: Mark) -> None:
        """Write a watermark into the open transaction."""
        values = (machine, _spool_bytes(spool_id), mark.seq, mark.lost, mark.newest_ns)
        self._db.execute("REPLACE INTO watermark VALUES (?, ?, ?, ?, ?, ?)", (*values, checksum(*values)))
        self._marks[machine, spool_id] = mark

    def commit(self) -> None:
        """Commit to disk; only then may anything be acknowledged."""
        self._db.execute("COMMIT")

    def rollback(self) -> None:
        """Give up the open transaction and return to what is on disk."""
        if self._db.in_transaction:
            self._db.execute("ROLLBACK")
        self._return_to_disk()

    def append_event(self, kind: str, stamp_ns: int, body: Mapping[str, Any]) -> int:
        """Commit an event, outside of any other transaction; returns its number."""
        text = json.dumps(body, allow_nan=False)
        self.begin()
        try:
            number = self._number("SELECT COALESCE(MAX(id), 0) + 1 FROM events")
            values = (number, kind, stamp_ns, text)
            self._db.execute("INSERT INTO events VALUES (?, ?, ?, ?, ?)", (*values, checksum(*values)))
            self.commit()
        except (sqlite3.Error, StoreError):
            self.rollback()
            raise
        return number

    def forget(self, until: int, most: int = _AT_ONCE) -> int:
        """Remove the next rows up to `until`, which are archived, and commit; returns the new `archived_row`.

        most: how many at most, so that batches need not wait long; call it again until `until` is reached.
        """
        archived = self.archived_row
        last = max(archived, min(until, archived + most, self.last_row))
        self.begin()
        try:
            for table in ("journal", "extent"):
                self._db.execute(f"DELETE FROM {table} WHERE row <= ?", (last,))
            self._db.execute("REPLACE INTO meta VALUES ('archived_row', ?)", (str(last),))
            self.commit()
        except sqlite3.Error:
            self.rollback()
            raise
        return last

    def shrink(self, most_pages: int = 100) -> int:
        """Give free pages back to the disk where more than SPARE of the file is free; returns how many.

        Fewer are kept for the rows to come. A journal that was made with schema 1 keeps all of them.
        """
        pages, free = (self._number(f"PRAGMA {name}") for name in ("page_count", "freelist_count"))
        spare = min(most_pages, free - int(SPARE * pages))
        if spare <= 0:
            return 0
        self._db.executescript(f"PRAGMA incremental_vacuum({spare})")  # `execute` would stop after the first page
        return free - self._number("PRAGMA freelist_count")

    def close(self) -> None:
        """Fold the write-ahead log into the file and close."""
        self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._db.close()

    def _create_or_check(self, site: str, frame: str) -> None:
        expected = {"schema": str(SCHEMA), "site": site, "frame": frame}
        if not self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone():
            self._db.executescript("BEGIN IMMEDIATE;" + TABLES)
            self._db.executemany("INSERT INTO meta VALUES (?, ?)", expected.items())
            self._db.execute("COMMIT")
        found = self._meta()
        for key, value in expected.items():
            if found.get(key) != value and not (key == "schema" and found.get(key) in UPGRADES):
                problem = f"the store has {key} {found.get(key)!r}, this server {value!r}; choose another --store"
                raise StoreError(self.path, problem)
        if found["schema"] in UPGRADES:
            self._db.executescript(UPGRADES[found["schema"]])
        self._plain_until = self._number(_PLAIN_UNTIL)

    def _return_to_disk(self) -> None:
        self._marks = self._load_marks()
        self.last_row = self._last_row()


class JournalReader(JournalReads):
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
                _lend_checksums(self._db)
                found = self._meta()
                if (schema := found.get("schema")) in SEEN:
                    self._db.executescript(SEEN[schema])
                elif schema != str(SCHEMA):
                    raise StoreError(path, f"the journal has schema {schema!r}, known is {SCHEMA}")
            except sqlite3.Error as error:
                raise StoreError(path, f"is no usable journal: {error}") from None
            self.site, self.frame = found.get("site", ""), found.get("frame", "")
            self._plain_until = LAST if schema == "1" else self._number(_PLAIN_UNTIL)
            opened.pop_all()

    @property
    def last_row(self) -> int:
        """The last row on disk, archived or not."""
        return self._last_row()

    def marks(self) -> dict[tuple[str, int], Mark]:
        """Progress of all spools."""
        return self._load_marks()

    def close(self) -> None:
        """Close the connection."""
        self._db.close()

    def __enter__(self) -> JournalReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _lend_checksums(db: sqlite3.Connection) -> None:
    """What the statements of journal_schema call."""
    db.create_function("checksum", -1, checksum, deterministic=True)
    db.create_function("extent_checksum", len(EXTENT_VALUES), extent_checksum, deterministic=True)


def _spool_bytes(spool_id: int) -> bytes:
    """SQLite integers are signed: 64-bit ids are stored as bytes."""
    return spool_id.to_bytes(8, "big")
