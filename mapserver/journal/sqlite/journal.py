"""The journal in SQLite, committed with FULL sync before acknowledgement. It is the truth.

A row is an admitted batch; its watermark in the same transaction gives exactly-once. `synchronous=NORMAL` lost
acknowledged rows in 398 of 400 simulated power cuts, FULL none (docs/how-the-map-comes-about.md). Rows up to
`archived_row` are in Parquet files (archive.py).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from mapserver.journal.journal import ROWS_AT_ONCE, UnwrittenError
from mapserver.journal.rows import JournalRow, Progress, SpoolKey, Watermark
from mapserver.journal.shortfall import EVENT, ROW, Shortfall, compare, marked, spool_name
from mapserver.journal.sqlite.reader import SCHEMA, TABLES, SqliteQueries
from mapserver.journal.table_writer import (
    Line,
    PlainEvent,
    TableWriter,
    event_lines,
    meta_line,
    new_meta,
    watermark_line,
)
from protocol.disk.high_water_mark import HighWaterMark, Traces, look_beside, mark_path
from protocol.errors import StoreError
from protocol.files import make_private

SPARE = 0.25  # share of free pages above which the file shrinks


class SqliteJournal(TableWriter, SqliteQueries):
    """See `Journal`. StoreError for any damage (`check`)."""

    fenced = ""

    def __init__(self, path: Path, site: str, frame: str, descends: Iterable[str] = ()) -> None:
        """descends: ids of the stores a new one is made from."""
        self.path, self._row = path, 0
        self._changed: dict[str, int] = {}  # by the open transaction, for the mark
        path.parent.mkdir(parents=True, exist_ok=True)
        traces = look_beside(path)  # before SQLite drops what it cannot use
        with ExitStack() as opened:
            try:
                make_private(path)
                self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
                opened.callback(self._db.close)
                self._db.execute("PRAGMA auto_vacuum=INCREMENTAL")  # affects only new files
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._db.execute(f"PRAGMA journal_size_limit={64 * 2**20}")
                self._create_or_check(site, frame, descends)
                self._row = super().last_row
                self.check()
                self.epoch = self.state().epoch + 1
                self._db.execute("REPLACE INTO meta VALUES (?, ?, ?)", meta_line("epoch", str(self.epoch)))
                self._return_to_disk()
                self._mark = HighWaterMark(mark_path(path))
                opened.callback(self._mark.close)
                self._compare(traces)
            except (sqlite3.Error, OSError) as error:
                raise StoreError(path, f"is no usable journal: {error}") from None
            opened.pop_all()

    @property
    def last_row(self) -> int:
        """The last row, including the open transaction."""
        return self._row

    @property
    def trusted_row(self) -> int:
        """See `Journal`; the folder is the journal's own."""
        return self._row

    def begin(self) -> None:
        """Open a transaction, a group commit."""
        self._write("BEGIN IMMEDIATE")

    def _insert(self, row: int, record: bytes, extent: Line) -> None:
        self._write("INSERT INTO journal VALUES (?, ?)", (row, record))
        self._write("INSERT INTO extent VALUES (?, ?, ?, ?, ?, ?, ?, ?)", extent)
        self._row = row

    def put_watermark(self, machine: str, spool_id: int, watermark: Watermark) -> None:
        """See `Journal`."""
        line = watermark_line(machine, spool_id, watermark)
        self._write("REPLACE INTO watermark VALUES (?, ?, ?, ?, ?, ?)", line)
        self._progress.put(machine, spool_id, watermark)
        self._changed[spool_name(machine, spool_id)] = watermark.seq

    def commit(self) -> None:
        """Commit to disk, before anything is acknowledged."""
        self._write("COMMIT")
        if self._changed:
            self._mark.write({ROW: self._row, **self._changed})
            self._changed.clear()

    def rollback(self) -> None:
        """Abort the open transaction and return to what is on disk."""
        if self._db.in_transaction:
            self._write("ROLLBACK")
        self._return_to_disk()

    def append_events(self, events: Iterable[PlainEvent]) -> int:
        """See `Journal`."""
        lines = event_lines(events, self._last_event())
        with self._transaction():
            for line in lines:
                self._write("INSERT INTO events VALUES (?, ?, ?, ?, ?)", line)
            if lines:
                self._changed[EVENT] = lines[-1][0]
                self._put_meta("event", lines[-1][0])
            return self._last_event()

    def note_shortfall(self, shortfall: Shortfall) -> None:
        """See `Journal`; checkpointed, as damage to the log could remove it."""
        super().note_shortfall(shortfall)
        self._write("PRAGMA wal_checkpoint(TRUNCATE)")

    def follow_archive(self, row: int, watermarks: Mapping[SpoolKey, Watermark]) -> None:
        """Continue a new journal after an archive's rows and watermarks."""
        with self._transaction():
            self._write("INSERT INTO sqlite_sequence VALUES ('journal', ?)", (row,))
            self._put_meta("archived_row", row)
            self._row = row
            for spool, watermark in watermarks.items():
                self.put_watermark(*spool, watermark)

    def forget(self, until: int, most: int = ROWS_AT_ONCE) -> int:
        """See `Journal`."""
        archived = self.archived_row
        last = max(archived, min(until, archived + most, self.last_row))
        with self._transaction():
            for table in ("journal", "extent"):
                self._write(f"DELETE FROM {table} WHERE row <= ?", (last,))  # noqa: S608 # one of two constants
            self._put_meta("archived_row", last)
        return last

    def shrink(self, most_pages: int = 100) -> int:
        """Return free pages beyond the share SPARE to the disk; returns their number."""
        pages, free = (self._number(f"PRAGMA {name}") for name in ("page_count", "freelist_count"))
        spare = min(most_pages, free - int(SPARE * pages))
        if spare <= 0:
            return 0
        try:
            self._db.executescript(f"PRAGMA incremental_vacuum({spare})")  # `execute` would stop after one page
        except sqlite3.Error as error:
            raise UnwrittenError(self.path, str(error)) from None
        return free - self._number("PRAGMA freelist_count")

    def close(self) -> None:
        """Checkpoint the write-ahead log and close."""
        self._write("PRAGMA wal_checkpoint(TRUNCATE)")
        self._db.close()
        self._mark.close()

    def _put_meta(self, key: str, number: int) -> None:
        self._write("REPLACE INTO meta VALUES (?, ?, ?)", meta_line(key, str(number)))

    def _write(self, statement: str, values: Sequence[Any] = ()) -> None:
        try:
            self._db.execute(statement, values)
        except sqlite3.Error as error:
            raise UnwrittenError(self.path, str(error)) from None

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self.begin()
        try:
            yield
            self.commit()
        except StoreError:
            self.rollback()
            raise

    def _create_or_check(self, site: str, frame: str, descends: Iterable[str]) -> None:
        if not self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone():
            self._db.executescript("BEGIN IMMEDIATE;" + TABLES)
            meta = new_meta(SCHEMA, site, frame, descends)
            self._db.executemany("INSERT INTO meta VALUES (?, ?, ?)", meta)
            self._db.execute("COMMIT")
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # protects the store's id from damage of the log
        self._require_meta(site, frame)

    def _compare(self, traces: Traces) -> None:
        """Compare with the mark and the log, and note what is missing."""
        present = marked(self.last_row, self._last_event(), self.watermarks())
        if shortfall := compare(traces, present):
            with suppress(OSError):  # a full disk; the shortfall is noted anyway
                traces.keep_log(self.last_row)
            self._require_agreement()
            self.note_shortfall(shortfall)
        with suppress(OSError):  # a mark that lags causes no alarm, or is compared again
            self._mark.replace(marked(self.last_row, self._last_event(), self.watermarks()))

    def _require_agreement(self) -> None:
        """StoreError for pages of different times, as damaged logs leave.

        A watermark behind its rows would admit samples twice.
        """
        ((verdict,), *_) = self._query("PRAGMA integrity_check(1)")
        reached = all(row.first_seq + len(row.rows) - 1 <= self._seq_of(row) for row in self.read(self.archived_row))
        if verdict != "ok" or not reached:
            raise self._damaged("what its write-ahead log left")

    def _seq_of(self, row: JournalRow) -> int:
        return self.watermark(row.machine, row.spool_id).seq

    def _return_to_disk(self) -> None:
        self._progress = Progress(self._load_watermarks())
        self._row = super().last_row
        self._changed.clear()
