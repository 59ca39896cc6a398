"""The writer of a journal in PostgreSQL; rows, watermarks and row numbers are one transaction.

A commit is one message, gathered in memory. It names epoch and last row and fails if the journal has others, so a
writer that lost its lock acknowledges nothing. If its answer is lost, the writer takes lock and a new epoch, which
waits for a pending commit, and looks.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import psycopg

from mapserver.journal.journal import ROWS_AT_ONCE, FencedError, UnwrittenError, Waiting
from mapserver.journal.postgres import MARK_FILE
from mapserver.journal.postgres.connection import SCHEMA, Connection, connect, shown
from mapserver.journal.postgres.mark import CHECKSUM, EPOCH, STORE, known_store, store_in, traces_of, trusted_by
from mapserver.journal.postgres.reader import PostgresQueries
from mapserver.journal.postgres.session import HANGS_S, WriterSession
from mapserver.journal.postgres.tables import CHANNEL, creation, insert, literal
from mapserver.journal.records import checksum_of
from mapserver.journal.rows import Progress, SpoolKey, Watermark
from mapserver.journal.shortfall import EVENT, ROW, compare, marked, spool_name
from mapserver.journal.table_writer import Line, PlainEvent, TableWriter, event_lines, watermark_line
from protocol.disk.high_water_mark import HighWaterMark
from protocol.errors import StoreError
from protocol.files import make_private

_WHOSE = "SELECT epoch, writer FROM head"
LOOK_S = 0.1  # interval of attempts to take the lock
_PUT = (
    "ON CONFLICT (machine, spool_id) DO UPDATE SET"
    " seq = excluded.seq, lost = excluded.lost, newest_ns = excluded.newest_ns, crc32 = excluded.crc32"
)
log = logging.getLogger("mapserver.journal.postgres.journal")


def prepare(url: str, folder: Path, site: str, frame: str) -> None:
    """Create missing tables; StoreError if it is no usable journal."""
    with closing(WriterSession(url, shown(url))) as session:
        _prepare(session, shown(url), folder, site, frame)


def _prepare(
    session: WriterSession, where: str, folder: Path, site: str, frame: str, descends: Iterable[str] = ()
) -> None:
    """As `prepare`; not if the folder belongs to a store, whose restore a new one would obstruct."""
    if not (known := store_in(folder)):
        session.run(creation(site, frame, descends))
    elif not _is_there(session):
        raise _gone(where, f"{folder} is of journal {known}", "choose another --store for a new one")


def _is_there(session: WriterSession) -> bool:
    ((there,),) = session.run(f"SELECT to_regclass('{SCHEMA}.meta') IS NOT NULL")  # a constant
    return bool(there)


def _gone(where: str, was: str, or_else: str) -> StoreError:
    return StoreError(where, f"holds no journal, and {was}; restore the database from a backup, or {or_else}")


class PostgresJournal(TableWriter, PostgresQueries):
    """See `Journal`. Reads on a separate session."""

    def __init__(
        self,
        url: str,
        folder: Path,
        site: str,
        frame: str,
        descends: Iterable[str] = (),
        waiting: Waiting | None = None,
    ) -> None:
        """folder: of the server, for its mark. waiting: while another one writes; without it StoreError."""
        super().__init__(url)
        self.fenced, self.epoch = "", 0
        self._name = secrets.token_hex(8)  # recognises its epochs, because the answer to taking one may be lost
        self._row = self._newest = self._committed = 0
        self._rows: list[tuple[int, bytes]] = []
        self._extents: list[Line] = []
        self._puts: dict[SpoolKey, Watermark] = {}
        self._before: dict[SpoolKey, Watermark | None] = {}
        self._progress = Progress({})
        with ExitStack() as opened:
            self._session = WriterSession(url, self.where, self._on_loss)
            opened.callback(self._close_sessions)
            _prepare(self._session, self.where, folder, site, frame, descends)
            self._mark = _opened_mark(folder)
            opened.callback(self._mark.close)
            self._require(folder, site, frame)
            while not self._take_turn(waiting):
                pass
            opened.pop_all()

    @property
    def last_row(self) -> int:
        """The last row, including the open transaction."""
        return self._row

    @property
    def replica(self) -> str:
        """See `Journal`; some seconds old."""
        return self._session.replica

    def begin(self) -> None:
        """See `Journal`. A lost session is replaced, with the lock and a new epoch."""
        if self.fenced:
            raise FencedError(self.where, self.fenced)
        if self._session.lost:
            self._open_again()

    def put_watermark(self, machine: str, spool_id: int, watermark: Watermark) -> None:
        """See `Journal`."""
        key = (machine, spool_id)
        if key not in self._puts:
            self._before[key] = self._progress.known(key)
        self._puts[key] = watermark
        self._progress.put(machine, spool_id, watermark)

    def commit(self) -> None:
        """See `Journal`; even without writes, or a fenced writer might acknowledge."""
        puts = [watermark_line(*key, watermark) for key, watermark in self._puts.items()]
        self._run(
            self._advance(self._row, self._newest),
            insert("journal", self._rows),
            insert("extent", self._extents),
            insert("watermark", puts, _PUT),
        )
        self._committed = self._row
        changed = {spool_name(*key): watermark.seq for key, watermark in self._puts.items()}
        if self._rows:
            changed |= {ROW: self._row, CHECKSUM: checksum_of(self._rows[-1][1])}
        self._forget_puts()
        if changed:
            self._mark.write(changed)

    def rollback(self) -> None:
        """See `Journal`; `begin` reads what else is on disk."""
        if self._puts:
            known = self._progress.watermarks() | {key: mark for key, mark in self._before.items() if mark}
            self._progress = Progress({key: known[key] for key in known if self._before.get(key, True)})
        self._row = self._committed
        self._forget_puts()

    def append_events(self, events: Iterable[PlainEvent]) -> int:
        """See `Journal`."""
        self.begin()
        lines = event_lines(events, self._newest)
        if lines:
            number = lines[-1][0]
            self._run(self._advance(self._row, number), insert("events", lines))
            self._newest = number
            self._mark.write({EVENT: number})
        return self._newest

    def forget(self, until: int, most: int = ROWS_AT_ONCE) -> int:
        """See `Journal`."""
        self.begin()
        archived = self.archived_row
        last = max(archived, min(until, archived + most, self._row))
        self._run(
            self._advance(self._row, self._newest),
            f"DELETE FROM journal WHERE row <= {last}",  # noqa: S608 # a number
            f"DELETE FROM extent WHERE row <= {last}",  # noqa: S608
            f"UPDATE head SET archived_row = {last}",  # noqa: S608
        )
        return last

    def shrink(self) -> int:
        """See `Journal`; PostgreSQL does it."""
        return 0

    def close(self) -> None:
        """See `Journal`."""
        self._close_sessions()
        self._mark.close()

    def _insert(self, row: int, record: bytes, extent: Line) -> None:
        self._rows.append((row, record))
        self._extents.append(extent)
        self._row = row

    def _advance(self, row: int, event: int) -> str:
        """First statement of each transaction: fails unless this writer's state is the newest."""
        return f"SELECT advance({self.epoch}, {self._committed}, {row}, {self._newest}, {event})"

    def _run(self, *statements: str) -> None:
        try:
            self._session.run("; ".join(filter(None, (*statements, f"NOTIFY {CHANNEL}"))).encode())
        except FencedError as error:
            self.fenced = error.problem
            raise

    def _forget_puts(self) -> None:
        self._rows, self._extents, self._puts, self._before = [], [], {}, {}

    def _take_turn(self, waiting: Waiting | None) -> bool:
        """Become the writer; False to wait, if the session was lost."""
        self._take_lock(waiting)
        try:
            self._require_same()
            self._take_epoch(self._mark.values.get(EPOCH, 0))
            self._return_to_disk()
            if not (waiting and waiting.has_checked(self)):
                self.check()
            self.trusted_row = trusted_by(self._mark.values, self)
            self._compare()
        except StoreError as error:
            if waiting is None or not self._session.lost:
                raise
            log.warning("journal not taken yet problem=%r", str(error))
            self.epoch = 0
        self.fenced = ""
        return self.epoch > 0

    def _take_lock(self, waiting: Waiting | None) -> None:
        """Wait until the lock is free; without `waiting`, as long as the database needs to notice a dead holder."""
        end_s = time.monotonic() + 2 * HANGS_S
        while True:
            with suppress(UnwrittenError):
                if self._session.lost:
                    self._close_sessions()
                    self._session = WriterSession(self._url, self.where, self._on_loss)
                if self._session.take_lock():
                    return
            if waiting is None and time.monotonic() > end_s:
                problem = self._session.lost or "another server is writing this journal; stop it first"
                raise StoreError(self.where, problem)
            (waiting.follow if waiting else time.sleep)(LOOK_S)

    def _require(self, folder: Path, site: str, frame: str) -> None:
        """StoreError for another site or journal's folder; the folder belongs to this journal then."""
        self._require_meta(site, frame)
        known, store = known_store(self._mark.values), self.identity().id
        if known and known != store:
            problem = f"belongs to journal {known}, and {self.where} is {store}; choose another --store"
            raise StoreError(folder, problem)
        if not known:
            self._mark.write({STORE: int(store, 16)})
        self._close_reads()  # a long wait would outlast it

    def _require_same(self) -> None:
        """StoreError if the database has another journal than before the wait, as after a restore."""
        store = known_store(self._mark.values)
        if not _is_there(self._session):
            raise _gone(self.where, f"this server waited for journal {store}", "start it with another --store")
        if (now := self.identity().id) != store:
            raise StoreError(self.where, f"is journal {now} now, and this server waited for {store}; start it again")

    def _take_epoch(self, known: int) -> None:
        """Become the newest writer; waits for a pending commit. known: an earlier epoch, for restored databases."""
        values = f"epoch = GREATEST(epoch, {known}) + 1, writer = {literal(self._name)}"
        ((self.epoch,),) = self._session.run(f"UPDATE head SET {values} RETURNING epoch")  # noqa: S608 # a number
        log.info("journal taken epoch=%d", self.epoch)

    def _open_again(self) -> None:
        """Continue after a lost session unless another server has written, or retry later."""
        self._close_sessions()
        try:
            self._session = WriterSession(self._url, self.where, self._on_loss)
            self._take_again()
        except FencedError:
            raise
        except StoreError as error:
            self._session.close()
            log.warning("journal not open yet problem=%r", str(error))
            raise UnwrittenError(self.where, "the journal's database is away, or its lock is not free yet") from None

    def _take_again(self) -> None:
        is_free = self._session.take_lock()
        ((epoch, writer),) = self._session.run(_WHOSE)
        if self._is_taken_over(epoch, writer):
            self._fence(self._taken_over(epoch))
        if not is_free:
            raise StoreError(self.where, "the last session still has its lock")
        if epoch < self.epoch or not self._has_all():
            self._fence(
                "it is another journal than before, or lacks rows that were acknowledged; start this server again"
            )
        self._take_epoch(epoch)
        if super().state().event != self._newest:
            self._fence("a decision was committed whose answer was lost")
        self._return_to_disk()
        self._note_mark()

    def _has_all(self) -> bool:
        """Whether it is the same journal, with all known rows."""
        if self.identity().id != known_store(self._mark.values) or super().state().row < self._committed:
            return False
        is_archived = self._committed <= self.archived_row
        return is_archived or self.row_checksum(self._committed) == self._mark.values.get(CHECKSUM)

    def _is_taken_over(self, epoch: int, writer: str) -> bool:
        return epoch > self.epoch > 0 and writer != self._name

    def _taken_over(self, epoch: int) -> str:
        return f"another server has taken over the journal, with epoch {epoch} after {self.epoch}"

    def _fence(self, why: str) -> None:
        self.fenced = why
        self._session.close()
        raise FencedError(self.where, why)

    def _on_loss(self) -> None:
        """Look for a take-over, because the writer itself may be idle."""
        if not self.epoch:  # waiting for its turn
            return
        with suppress(psycopg.Error), connect(self._url, "lost", target_session_attrs="read-write") as db:
            ((epoch, writer),) = db.execute(_WHOSE).fetchall()
            if self._is_taken_over(epoch, writer):
                self.fenced = self._taken_over(epoch)
                self._session.cut()

    def _return_to_disk(self) -> None:
        self._progress = Progress(self._load_watermarks())
        state = super().state()
        self._row = self._committed = state.row
        self._newest = state.event
        self._forget_puts()

    def _compare(self) -> None:
        """Compare with the mark, and note what is missing."""
        present = marked(self._row, self._newest, self.watermarks())
        if shortfall := compare(traces_of(self._mark.values, self._mark.path), present):
            self.note_shortfall(shortfall)
        self._note_mark()

    def _note_mark(self) -> None:
        present = marked(self._row, self._newest, self.watermarks())
        store, checksum = int(self.identity().id, 16), self.row_checksum(self._row) or 0
        with suppress(OSError):  # a mark that lags causes no alarm, or is compared again
            self._mark.replace({**present, STORE: store, EPOCH: self.epoch, CHECKSUM: checksum})

    def _close_sessions(self) -> None:
        self._session.close()
        self._close_reads()

    def _close_reads(self) -> None:
        if self._db is not None:
            self._db.close()

    def _connected(self) -> Connection:
        if self._db is None or self._db.closed:
            self._db = connect(self._url, "writer's reads", target_session_attrs="read-write")
        return self._db


def _opened_mark(folder: Path) -> HighWaterMark:
    try:
        make_private(folder / MARK_FILE)
        return HighWaterMark(folder / MARK_FILE)
    except OSError as error:
        raise StoreError(folder / MARK_FILE, f"cannot be used: {error.strerror}") from None
