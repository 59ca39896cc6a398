"""The spool: samples on the machine's own disk until the server has acknowledged them (SQLite, WAL, FULL).

`seq` numbers samples 1, 2, 3... within a spool; `spool_id` is drawn when the spool is made, and anew when the server
turns out to know more of it than it does itself (a restored or cloned file).
"""

from __future__ import annotations

import secrets
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from agents.audit import AuditLog
from protocol.arrays import Table
from protocol.errors import StoreError
from protocol.samples import SAMPLE_DTYPE

SCHEMA = 1
_TABLES = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE sample (seq INTEGER PRIMARY KEY, row BLOB NOT NULL, final INTEGER NOT NULL)",
    "CREATE TABLE aside (spool_id TEXT NOT NULL, seq INTEGER NOT NULL, row BLOB NOT NULL, problem TEXT NOT NULL)",
    f"PRAGMA user_version={SCHEMA}",
)


@dataclass(frozen=True)
class SpoolConfig:
    """max_samples: beyond so many the oldest are dropped, counted, and declared lost to the server."""

    max_samples: int = 2_000_000

    def __post_init__(self) -> None:
        if self.max_samples < 1:
            raise ValueError("max_samples: must be positive")


@dataclass(frozen=True)
class Head:
    """The oldest samples that are final. lost_before: how many directly before them will never be sent."""

    spool_id: int
    first_seq: int
    rows: Table
    lost_before: int


@dataclass(frozen=True)
class _Meta:
    """What the spool knows of itself: its identity, the last number given out, the last acknowledged, and counts."""

    spool_id: int
    newest: int = 0
    acknowledged: int = 0
    dropped: int = 0
    recorded: int = 0


def random_id() -> int:
    """A spool's identity: 64 random bits, never zero."""
    return secrets.randbits(64) or 1


class Spool:
    """One machine's samples that are not yet acknowledged. All methods may be called from any thread."""

    def __init__(
        self,
        path: Path,
        config: SpoolConfig,
        audit: AuditLog | None = None,
        draw_id: Callable[[], int] = random_id,
    ) -> None:
        self._path = path
        self._config = config
        self._audit = audit
        self._draw_id = draw_id
        self._lock = threading.Lock()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._meta = self._open()
            self._newest_at_open = self._meta.newest
            if audit:
                audit.reconcile(self._meta.spool_id, self._meta.newest)
        except (sqlite3.Error, ValueError, KeyError) as error:
            raise StoreError(path, f"is no usable spool: {error}") from None

    @property
    def spool_id(self) -> int:
        """Identity of this spool."""
        return self._meta.spool_id

    @property
    def newest(self) -> int:
        """The last sequence number given out."""
        return self._meta.newest

    @property
    def acknowledged(self) -> int:
        """The last sample that the server has confirmed."""
        return self._meta.acknowledged

    def counters(self) -> dict[str, int]:
        """Depth, and what never reached the server."""
        with self._lock:
            depth = self._db.execute("SELECT COUNT(*) FROM sample").fetchone()[0]
            aside = self._db.execute("SELECT COUNT(*) FROM aside").fetchone()[0]
        return {"depth": depth, "dropped": self._meta.dropped, "put_aside": aside, "recorded": self._meta.recorded}

    def record(self, rows: Table, *, final: bool = True) -> int:
        """Write samples durably; returns the sequence number of the first. StoreError if the disk does not take them.

        Pending ones (not final) are not sent before they are made final.
        """
        with self._lock:
            first = self._meta.newest + 1
            if self._audit:
                self._audit.recorded(self._meta.spool_id, first, rows)
            try:
                self._meta = self._insert(first, rows, final=final)
            except sqlite3.Error as error:
                raise StoreError(self._path, f"cannot be written: {error}; look at the machine's disk") from None
            return first

    def _insert(self, first: int, rows: Table, *, final: bool) -> _Meta:
        values = [(first + i, row.tobytes(), int(final)) for i, row in enumerate(rows)]
        old, n = self._meta, len(rows)
        with _transaction(self._db):
            self._db.executemany("INSERT INTO sample VALUES (?, ?, ?)", values)
            dropped = old.dropped + self._drop_oldest()
            new = replace(old, newest=old.newest + n, recorded=old.recorded + n, dropped=dropped)
            self._save(new)
        return new

    def finalise(self, first_seq: int, rows: Table) -> None:
        """Replace pending samples by their final values."""
        with self._lock, _transaction(self._db):
            if self._audit:
                self._audit.recorded(self._meta.spool_id, first_seq, rows)
            values = [(row.tobytes(), first_seq + i) for i, row in enumerate(rows)]
            self._db.executemany("UPDATE sample SET row = ?, final = 1 WHERE seq = ? AND final = 0", values)

    def head(self, limit: int) -> Head | None:
        """The oldest final samples, at most `limit`, without a hole between them; None if there are none."""
        with self._lock:
            query = "SELECT seq, row, final FROM sample ORDER BY seq LIMIT ?"
            found = self._db.execute(query, (limit,)).fetchall()
            ready: list[tuple[int, bytes]] = []
            for seq, row, final in found:
                if not final or (ready and seq != ready[-1][0] + 1):
                    break
                ready.append((seq, row))
            if not ready:
                return None
            rows = np.frombuffer(b"".join(row for _, row in ready), SAMPLE_DTYPE)
            return Head(self._meta.spool_id, ready[0][0], rows, ready[0][0] - 1 - self._meta.acknowledged)

    def acknowledge(self, watermark: int) -> None:
        """Delete what the server has on disk."""
        with self._lock:
            new = replace(self._meta, acknowledged=watermark)
            with _transaction(self._db):
                self._db.execute("DELETE FROM sample WHERE seq <= ?", (watermark,))
                self._save(new)
            self._meta = new

    def put_aside(self, head: Head, problem: str) -> None:
        """Keep samples that the server will never take out of the way, for a person to look at."""
        with self._lock, _transaction(self._db):
            seqs = range(head.first_seq, head.first_seq + len(head.rows))
            values = [(f"{head.spool_id:016x}", s, r.tobytes(), problem) for s, r in zip(seqs, head.rows, strict=True)]
            self._db.executemany("INSERT INTO aside VALUES (?, ?, ?, ?)", values)
            self._db.executemany("DELETE FROM sample WHERE seq = ?", [(seq,) for seq in seqs])

    def meet(self, watermark: int) -> bool:
        """First contact after opening: compare with the server's watermark; returns whether a new spool_id was drawn.

        A watermark beyond what was on disk when the spool was opened tells of a restored or cloned file. What the file
        held then has been delivered; what was recorded since has numbers that are taken, and gets a new identity.
        """
        if watermark <= self._newest_at_open:
            self.acknowledge(watermark)
            return False
        with self._lock:
            seqs = self._db.execute("SELECT seq, row FROM sample WHERE seq > ?", (self._newest_at_open,)).fetchall()
            rows = np.frombuffer(b"".join(row for _, row in seqs), SAMPLE_DTYPE)
            new = replace(self._meta, spool_id=self._draw_id(), newest=len(rows), acknowledged=0)
            if self._audit:
                self._audit.renumbered(self._meta.spool_id, [seq for seq, _ in seqs], new.spool_id, rows)
            with _transaction(self._db):
                self._db.execute("DELETE FROM sample")
                values = [(i + 1, row.tobytes()) for i, row in enumerate(rows)]
                self._db.executemany("INSERT INTO sample VALUES (?, ?, 1)", values)
                self._save(new)
            self._meta, self._newest_at_open = new, new.newest
        return True

    def close(self) -> None:
        """Fold the write-ahead log into the file and close."""
        with self._lock:
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._db.close()
            if self._audit:
                self._audit.close()

    def _open(self) -> _Meta:
        if not self._db.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone():
            with _transaction(self._db):  # tables and identity together: a kill leaves all or nothing
                for statement in _TABLES:
                    self._db.execute(statement)
                self._save(_Meta(self._draw_id()))
        if (schema := self._db.execute("PRAGMA user_version").fetchone()[0]) != SCHEMA:
            raise ValueError(f"schema {schema}, this agent knows {SCHEMA}")
        # After a crash pending samples are sent as they are: a coarse place is better than none.
        self._db.execute("UPDATE sample SET final = 1 WHERE final = 0")
        values = dict(self._db.execute("SELECT key, value FROM meta"))
        return _Meta(int(values.pop("spool_id"), 16), **{key: int(value) for key, value in values.items()})

    def _drop_oldest(self) -> int:
        """Keep to the limit; returns how many were dropped."""
        first, last = self._db.execute("SELECT MIN(seq), MAX(seq) FROM sample").fetchone()
        if first is None or last - first < self._config.max_samples:  # counting takes time that grows with the spool
            return 0
        depth: int = self._db.execute("SELECT COUNT(*) FROM sample").fetchone()[0]
        excess = max(0, depth - self._config.max_samples)
        if excess:
            oldest = "SELECT seq FROM sample ORDER BY seq LIMIT ?"
            self._db.execute(f"DELETE FROM sample WHERE seq IN ({oldest})", (excess,))  # noqa: S608 - no input in it
        return excess

    def _save(self, meta: _Meta) -> None:
        values = {**asdict(meta), "spool_id": f"{meta.spool_id:016x}"}
        self._db.executemany("REPLACE INTO meta VALUES (?, ?)", [(key, str(value)) for key, value in values.items()])


class _transaction:  # noqa: N801 - used like a keyword
    """All or nothing; an error rolls back and goes on up."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def __enter__(self) -> None:
        self._db.execute("BEGIN IMMEDIATE")

    def __exit__(self, kind: object, *_: object) -> None:
        self._db.execute("ROLLBACK" if kind else "COMMIT")
