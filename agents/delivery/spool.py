"""The spool: samples on the machine's own disk until the server has acknowledged them (SQLite, WAL, FULL).

Samples are numbered through the file. All that is recorded between two openings is a **run** with a random `spool_id`;
`seq` counts 1, 2, 3... within it, so seq = number - base. A file that was copied, cloned, restored or set back by a
lying disk thus never gives one identity to two samples: samples that copies share have the same identity and bytes
(except pending positions), and later ones have another spool_id.

The newest samples may be **pending**: on disk with the filter's position, but not sent before the smoother's arrives.
Only memory knows which ones. After a restart they count as final: a coarse position is better than none.
"""

import contextlib
import secrets
import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from agents.delivery.audit import AuditLog
from agents.delivery.spool_file import (
    RunEnd,
    checksum,
    checksum_of,
    connect,
    make_or_check,
    runs_cut_short,
    transaction,
    why_unusable,
)
from agents.delivery.uplink import Head
from protocol.arrays import Table
from protocol.disk.high_water_mark import HighWaterMark, Traces, look_beside, mark_path
from protocol.errors import StoreError
from protocol.machine.samples import SAMPLE_DTYPE, empty

KEPT_RUNS = 16  # earlier runs declared again, so that a server restored from a backup learns what it lost


@dataclass(frozen=True)
class SpoolConfig:
    """max_samples: capacity, without pending samples; beyond it the oldest are dropped and declared lost."""

    max_samples: int = 2_000_000

    def __post_init__(self) -> None:
        if self.max_samples < 1:
            raise ValueError("max_samples: must be positive")


@dataclass(frozen=True)
class SpoolRun:
    """What one opening recorded. base: number of the last sample before it. acknowledged: a seq.

    closed: the server has accounted for the whole run. store: id of the store that acknowledged samples of it, or
    empty.
    """

    base: int
    spool_id: int
    acknowledged: int = 0
    closed: bool = False
    store: str = ""


@dataclass(frozen=True)
class _Meta:
    """Counts of the file: last number given out, samples dropped, recorded, and lost with the disk."""

    newest: int
    dropped: int
    recorded: int
    gone: int


_SampleRow = tuple[int, bytes, int]  # number, sample, checksum


def random_id() -> int:
    """64 random bits, never zero."""
    return secrets.randbits(64) or 1


class Spool:
    """One machine's unacknowledged samples; thread-safe.

    StoreError: the file is damaged or in use, or the disk is full or fails. damage: what the file had lost when opened,
    in one line, or empty.
    """

    def __init__(
        self, path: Path, config: SpoolConfig, audit: AuditLog | None = None, draw_id: Callable[[], int] = random_id
    ) -> None:
        self._path = path
        self._config = config
        self._audit = audit
        self._draw_id = draw_id
        self._lock = threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        traces = look_beside(path)  # before SQLite drops what it cannot use
        with contextlib.ExitStack() as opened:
            try:
                self._db = self._connect(path)
                opened.callback(self._db.close)
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._mark = HighWaterMark(mark_path(path))
                opened.callback(self._mark.close)
                self._open(traces)
            except (sqlite3.Error, OSError, ValueError, KeyError, TypeError) as error:
                raise StoreError(path, why_unusable(error)) from None
            opened.pop_all()

    @property
    def spool_id(self) -> int:
        """Id of the current run."""
        return self._runs[-1].spool_id

    @property
    def newest(self) -> int:
        """Last seq of the current run."""
        return self._end(len(self._runs) - 1)

    @property
    def acknowledged(self) -> int:
        """Last acknowledged seq of the current run."""
        return self._runs[-1].acknowledged

    def counters(self) -> dict[str, int]:
        """Depth, pending samples, and those that never reached the server."""
        with self._lock:  # counted on the way: a query would be slow on a full spool
            meta = self._meta
            return {
                "depth": self._depth,
                "pending": self._held_back,
                "dropped": meta.dropped,
                "put_aside": self._quarantined,
                "recorded": meta.recorded,
                "gone": meta.gone,
            }

    def is_settled(self) -> bool:
        """Whether nothing is left to send and the server has accounted for all earlier runs."""
        with self._lock:
            return self._depth == 0 and self._sending == len(self._runs) - 1

    def record(self, rows: Table, *, pending: int = 0, finals: Table | None = None) -> int:
        """Write samples in one durable transaction; returns the seq of the first new one.

        rows: new samples, the last `pending` of them not final. finals: final values of those pending longest, in
        order. ValueError if a sample would become final before an earlier one.
        """
        finals = empty() if finals is None else finals
        left = self._pending - len(finals)
        if left < 0 or not 0 <= pending <= len(rows) or (left and pending < len(rows)):
            new = f"{pending} of {len(rows)} new ones"
            raise ValueError(f"{len(finals)} final values for {self._pending} pending samples and {new}")
        with self._access():
            base, first, oldest = self._runs[-1].base, self.newest + 1, self.newest - self._pending + 1
            gone = max(0, self.acknowledged + 1 - oldest)  # already delivered as pending by a copy of the file
            self._write(rows, finals[gone:], base + oldest + gone, left + pending)
            self._note(oldest + gone, finals[gone:])
            self._note(first, rows)
            return first

    def head(self, limit: int) -> Head | None:
        """The next samples to send: at most `limit` final ones without a gap, or None.

        Runs follow one another; a run without samples is closed with an empty head.
        """
        with self._access():
            run, end = self._runs[self._sending], self._end(self._sending)
            while damaged := _damaged(oldest := self._oldest(limit)):
                self._move_to_quarantine(run, damaged, "damaged on the machine's disk")
            newest = None if self._sending < len(self._runs) - 1 else end
            if not oldest:
                return Head(run.spool_id, end + 1, empty(), end, store=run.store) if newest is None else None
            first = oldest[0][0]
            n = next((i for i, (number, _, _) in enumerate(oldest) if number != first + i), None)
            seq, rows = first - run.base, _table(row for _, row, _ in oldest[:n])
            return Head(run.spool_id, seq, rows, seq - 1 - run.acknowledged, newest, run.store)

    def acknowledge(self, spool_id: int, watermark: int, store: str = "") -> None:
        """Delete what the server has on disk of one run, and bind the run to that store."""
        with self._access():
            at = self._index(spool_id)
            run, end = self._runs[at], self._end(at)
            upto = max(run.acknowledged, min(watermark, end))
            is_earlier = at < len(self._runs) - 1
            closed = run.closed or (is_earlier and watermark >= end)
            new = replace(run, acknowledged=upto, closed=closed, store=(upto and store) or run.store)
            with transaction(self._db):
                numbers = (run.base, run.base + upto)
                deleted = self._db.execute("DELETE FROM sample WHERE number > ? AND number <= ?", numbers).rowcount
                self._save_run(new)
            self._runs[at] = new
            self._mark.write(self._run_end(at).values())
            self._depth -= deleted
            if at == self._sending and is_earlier and watermark >= end:
                self._sending += 1

    def lower_watermark(self, spool_id: int, watermark: int) -> None:
        """Handle a server restored from a backup; its losses are declared, as the spool no longer has them."""
        with self._access():
            at = self._index(spool_id)
            new = replace(self._runs[at], acknowledged=watermark)
            with transaction(self._db):
                self._save_run(new)
            self._runs[at], self._sending = new, 0
            self._mark.write(self._run_end(at).values())

    def declare_again(self) -> None:
        """Close all earlier runs again, because the server may have lost journal rows."""
        with self._lock:
            self._sending = 0

    def start_new_run(self) -> None:
        """Renumber unacknowledged samples of this run: another agent sends under the same identity."""
        with self._access():
            old = self._runs[-1]
            new = SpoolRun(old.base + old.acknowledged, self._draw_id())
            waiting = self._db.execute("SELECT number, row FROM sample WHERE number > ?", (new.base,)).fetchall()
            ended = [replace(old, closed=True)] if old.acknowledged else []
            with transaction(self._db):
                self._db.execute("DELETE FROM run WHERE base = ?", (old.base,))
                for run in (*ended, new):
                    self._save_run(run)
            self._runs[-1:] = [*ended, new]
            self._mark.write(RunEnd(old.spool_id, old.acknowledged, old.acknowledged).values())
            self._mark.write(self._run_end(-1).values())
            self._sending = len(self._runs) - 1
            if self._audit and waiting:
                seqs = [number - old.base for number, _ in waiting]
                with contextlib.suppress(OSError):
                    self._audit.renumbered(old.spool_id, seqs, new.spool_id, _table(row for _, row in waiting))

    def quarantine(self, head: Head, problem: str) -> None:
        """Set aside samples that the server refuses for good, for a person to inspect."""
        with self._access():
            run = self._runs[self._index(head.spool_id)]
            first = run.base + head.first_seq
            self._move_to_quarantine(run, [(first + i, row.tobytes()) for i, row in enumerate(head.rows)], problem)

    def close(self) -> None:
        """Fold the write-ahead log into the file and close."""
        with self._lock:
            with contextlib.suppress(sqlite3.Error):  # full disk: the next opening reads the log
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._db.close()
            self._mark.close()
            if self._audit:
                self._audit.close()

    def _connect(self, path: Path) -> sqlite3.Connection:
        return connect(path)

    @contextlib.contextmanager
    def _access(self) -> Iterator[None]:
        with self._lock:
            try:
                yield
            except sqlite3.Error as error:
                raise StoreError(self._path, f"cannot be used: {error}; look at the machine's disk") from None

    def _open(self, traces: Traces) -> None:
        with transaction(self._db):  # in one transaction: a kill leaves all or nothing
            make_or_check(self._db)
            self._meta = _Meta(**{k: int(v) for k, v in self._db.execute("SELECT key, value FROM meta")})
            self._runs = self._runs_of_file()
            self.damage = self._compare(traces)
            self._start_run()
        with contextlib.suppress(OSError):  # an outdated mark raises no alarm
            self._mark.replace({k: n for i in range(len(self._runs)) for k, n in self._run_end(i).values().items()})
        self._sending = 0  # index of the run that is being sent
        self._pending = 0  # the newest samples of this run
        self._depth = int(self._db.execute("SELECT COUNT(*) FROM sample").fetchone()[0])
        self._quarantined = int(self._db.execute("SELECT COUNT(*) FROM quarantine").fetchone()[0])
        if self._audit:
            self._audit.complete(self._identified())

    def _runs_of_file(self) -> list[SpoolRun]:
        runs = [_run_from(*row) for row in self._db.execute("SELECT * FROM run ORDER BY base")]
        return [run for run in runs if run.base < self._meta.newest]

    def _compare(self, traces: Traces) -> str:
        """Compare the file with its mark; runs are extended to their marked end, so that losses are declared.

        If no log was cut short, a copy may have replaced the file. Missing samples are then counted, not declared: the
        other file may still be sent.
        """
        short = runs_cut_short([self._run_end(i) for i in range(len(self._runs))], traces.mark)
        gone, meta = sum(n for _, n in short), self._meta
        if traces.cut_short:
            for end, _ in short:
                if not self._runs or self._runs[-1].spool_id != end.spool_id:
                    self._runs.append(SpoolRun(meta.newest, end.spool_id, end.acknowledged))
                meta = replace(meta, newest=self._runs[-1].base + end.recorded)
        self._meta = replace(meta, gone=meta.gone + gone)
        self._save(self._meta)
        if traces.damage or gone:
            with contextlib.suppress(OSError):  # full disk: the damage is reported anyway
                traces.keep_log(self._meta.newest)
        lost = f"{gone} recorded samples are gone" if gone else ""
        return "; ".join(text for text in (traces.damage, lost) if text)

    def _start_run(self) -> None:
        """Add a run; keep runs that are not closed or among the last."""
        runs, last = self._runs, self._runs[-KEPT_RUNS:]
        first = next((i for i, run in enumerate(runs) if not run.closed or run in last), len(runs))
        self._runs = [*runs[first:], SpoolRun(self._meta.newest, self._draw_id())]
        self._db.execute("DELETE FROM run")
        for run in self._runs:
            self._save_run(run)

    def _identified(self) -> Iterator[tuple[int, int, Table]]:
        query = "SELECT number, row FROM sample WHERE number > ? AND number <= ?"
        for i, run in enumerate(self._runs):
            for number, row in self._db.execute(query, (run.base, run.base + self._end(i))):
                yield run.spool_id, number - run.base, _table([row])[0]

    def _end(self, at: int) -> int:
        is_last = at == len(self._runs) - 1
        return (self._meta.newest if is_last else self._runs[at + 1].base) - self._runs[at].base

    @property
    def _held_back(self) -> int:
        return min(self._pending, self.newest - self.acknowledged)

    def _last_final(self, at: int) -> int:
        """Last seq of a run that may be sent."""
        return self._end(at) - (self._pending if at == len(self._runs) - 1 else 0)

    def _run_end(self, at: int) -> RunEnd:
        run = self._runs[at]
        return RunEnd(run.spool_id, self._end(at % len(self._runs)), run.acknowledged)

    def _index(self, spool_id: int) -> int:
        return next(i for i, run in enumerate(self._runs) if run.spool_id == spool_id)

    def _write(self, rows: Table, finals: Table, oldest: int, pending: int) -> None:
        old, n = self._meta, len(rows)
        added, replaced = _numbered(rows, old.newest + 1), _numbered(finals, oldest)
        excess = max(0, self._depth + n - min(pending, self.newest + n - self.acknowledged) - self._config.max_samples)
        with transaction(self._db):
            self._db.executemany("UPDATE sample SET row = ?2, crc32 = ?3 WHERE number = ?1", replaced)
            self._db.executemany("INSERT INTO sample VALUES (?, ?, ?)", added)
            if excess:
                oldest_ones = "SELECT number FROM sample ORDER BY number LIMIT ?"
                self._db.execute(f"DELETE FROM sample WHERE number IN ({oldest_ones})", (excess,))  # noqa: S608 - no input
            new = replace(old, newest=old.newest + n, dropped=old.dropped + excess, recorded=old.recorded + n)
            self._save(new)
        self._meta, self._pending = new, pending
        self._mark.write(self._run_end(-1).values())
        self._depth += n - excess

    def _oldest(self, limit: int) -> list[_SampleRow]:
        base, end = self._runs[self._sending].base, self._last_final(self._sending)
        query = "SELECT * FROM sample WHERE number > ? AND number <= ? ORDER BY number LIMIT ?"
        return self._db.execute(query, (base, base + end, limit)).fetchall()

    def _move_to_quarantine(self, run: SpoolRun, rows: list[tuple[int, bytes]], problem: str) -> None:
        values = [(f"{run.spool_id:016x}", number - run.base, row, problem) for number, row in rows]
        with transaction(self._db):
            self._db.executemany("INSERT INTO quarantine VALUES (?, ?, ?, ?)", values)
            numbers = [(number,) for number, _ in rows]
            deleted = self._db.executemany("DELETE FROM sample WHERE number = ?", numbers).rowcount
            if deleted < len(rows):  # readable but not deletable: the file's structure is damaged
                raise sqlite3.DatabaseError(f"samples {rows[0][0]} and on cannot be removed: the file is damaged")
        self._quarantined += len(values)
        self._depth -= len(values)

    def _note(self, first_seq: int, rows: Table) -> None:
        """Audit samples before they can be sent; the next opening adds lines that a full disk prevented."""
        if self._audit and len(rows):
            with contextlib.suppress(OSError):
                self._audit.recorded(self.spool_id, first_seq, rows)

    def _save(self, meta: _Meta) -> None:
        values = [(key, str(value)) for key, value in asdict(meta).items()]
        self._db.executemany("REPLACE INTO meta VALUES (?, ?)", values)

    def _save_run(self, run: SpoolRun) -> None:
        values = (run.base, f"{run.spool_id:016x}", run.acknowledged, int(run.closed), run.store)
        self._db.execute("REPLACE INTO run VALUES (?, ?, ?, ?, ?, ?)", (*values, checksum_of(*values)))


def _damaged(rows: list[_SampleRow]) -> list[tuple[int, bytes]]:
    return [(number, row) for number, row, crc32 in rows if not _is_sound(number, row, crc32)]


def _is_sound(number: int, row: object, crc32: int) -> bool:
    return isinstance(row, bytes) and len(row) == SAMPLE_DTYPE.itemsize and crc32 == checksum(number, row)


def _run_from(base: int, spool_id: str, acknowledged: int, closed: int, store: str, crc32: int) -> SpoolRun:
    if crc32 != checksum_of(base, spool_id, acknowledged, closed, store):
        raise ValueError(f"what it knows of samples from {base} on is damaged; move the file away")
    return SpoolRun(base, int(spool_id, 16), acknowledged, bool(closed), store)


def _numbered(rows: Table, first: int) -> list[_SampleRow]:
    return [(number, data, checksum(number, data)) for number, data in enumerate(map(np.void.tobytes, rows), first)]


def _table(rows: Iterable[bytes]) -> Table:
    return np.frombuffer(b"".join(rows), SAMPLE_DTYPE)
