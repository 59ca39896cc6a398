"""Queries of a journal in PostgreSQL."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Any, Self

import psycopg

from mapserver.journal.journal import ROWS_AT_ONCE, JournalState
from mapserver.journal.postgres import connection
from mapserver.journal.postgres.connection import REPLICAS, Connection, connect, readable, replica_of, shown
from mapserver.journal.postgres.tables import CHANNEL, SCHEMA
from mapserver.journal.rows import Selection
from mapserver.journal.table_queries import BYTES_AT_ONCE, TableQueries, size_of
from protocol.errors import StoreError

_READ_ALL = "SELECT row, record FROM journal WHERE row > %(after)s AND row <= %(until)s ORDER BY row LIMIT %(most)s"
_READ_SOME = """SELECT row, record FROM extent LEFT JOIN journal USING (row)
WHERE extent.last_stamp_ns >= %(from_ns)s AND extent.first_stamp_ns <= %(to_ns)s
    AND west_m <= %(east_m)s AND east_m >= %(west_m)s AND south_m <= %(north_m)s AND north_m >= %(south_m)s
    AND row > %(after)s AND row <= %(until)s ORDER BY row LIMIT %(most)s"""
_RECEIVED = """SELECT pg_is_in_recovery(), pg_last_wal_receive_lsn()::text,
EXISTS (SELECT FROM pg_stat_wal_receiver WHERE COALESCE(status, 'streaming') = 'streaming')"""
_EVERYWHERE = {"west_m": -math.inf, "south_m": -math.inf, "east_m": math.inf, "north_m": math.inf}
_LOOK_S = 1.0  # polling interval, because notifications may be lost
_LOOK_AGAIN_S = 0.05  # polling interval at a replica, which has no notifications


class PostgresQueries(TableQueries):
    """Queries on a separate connection, reopened when lost."""

    schema = SCHEMA

    def __init__(self, url: str) -> None:
        self._url, self._where = url, shown(url)
        self._db: Connection | None = None

    @property
    def where(self) -> str:
        """The URL without password."""
        return self._where

    @property
    def last_row(self) -> int:
        """See `JournalQueries`."""
        return self.state().row

    @property
    def archived_row(self) -> int:
        """See `JournalQueries`."""
        return self._number("SELECT archived_row FROM head")

    @property
    def replica(self) -> str:
        """See `JournalQueries`."""
        ((synchronous, replicas),) = self._query(REPLICAS)
        return replica_of(synchronous=synchronous, replicas=replicas)

    def state(self) -> JournalState:
        """See `JournalQueries`."""
        rows = self._query("SELECT epoch, last_row, last_event FROM head")
        if not rows:
            raise self._damaged("the table head")
        return JournalState(*rows[0])

    def _last_event(self) -> int:
        return self.state().event

    def _query(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        with readable(self._where):
            return self._connected().execute(query.replace("?", "%s"), values, binary=True).fetchall()

    def _connected(self) -> Connection:
        """The connection, reopened when lost."""
        if self._db is None or self._db.closed:
            self._db = connect(self._url, "reader")
        return self._db

    @contextmanager
    def _one_state(self) -> Iterator[None]:
        with readable(self._where):
            self._connected().execute("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
        try:
            yield
        finally:
            with suppress(psycopg.Error, StoreError):  # a lost connection has ended it
                self._connected().execute("ROLLBACK")

    def _piece(self, after: int, until: int, selection: Selection) -> tuple[list[int], list[Any], bool]:
        """See `TableQueries`."""
        values: dict[str, float] = {"after": after, "until": until, "most": ROWS_AT_ONCE}
        query = _READ_ALL
        if not selection.everywhere:
            box = asdict(selection.bounds) if selection.bounds else _EVERYWHERE
            query, values = _READ_SOME, {**values, **box, "from_ns": selection.from_ns, "to_ns": selection.to_ns}
        numbers: list[int] = []
        records: list[Any] = []
        size, is_end = 0, False
        while size < BYTES_AT_ONCE and not is_end:
            with readable(self._where):
                part = self._connected().execute(query, values, binary=True).fetchall()
            numbers += [row for row, _ in part]
            records += [record for _, record in part]
            size += size_of([record for _, record in part])
            is_end = len(part) < ROWS_AT_ONCE
            values["after"] = numbers[-1] if numbers else after
        return numbers, records, is_end


def exists(url: str) -> bool:
    """Whether a database has a journal; StoreError if unreachable."""
    where = shown(url)
    with readable(where), connect(url, "look") as db:
        return bool(db.execute(f"SELECT to_regclass('{connection.SCHEMA}.meta') IS NOT NULL").fetchall()[0][0])


class PostgresReader(PostgresQueries):
    """See `JournalReader`; of the primary or a replica."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._listens: Connection | None = None
        self._noted: tuple[Any, float] | None = None  # what a replica had received, and when
        self._complete_s = -math.inf
        try:
            meta = self._meta()
        except StoreError:
            self.close()
            raise
        self.site, self.frame = meta.get("site", ""), meta.get("frame", "")

    @property
    def is_replica(self) -> bool:
        """See `JournalReader`."""
        return bool(self._query("SELECT pg_is_in_recovery()")[0][0])

    def complete_s(self) -> float:
        """See `JournalReader`; for a replica, when it had received what is replayed now.

        A hanging link to the primary is noticed after `wal_receiver_timeout`.
        """
        now_s = time.monotonic()
        ((is_replica, received, streams),) = self._query(_RECEIVED)
        if not is_replica:
            return now_s
        if not streams:
            self._noted = None
            return self._complete_s
        lsn, since_s = self._noted or (received, now_s)
        self._noted = lsn, since_s
        if self._query("SELECT pg_last_wal_replay_lsn() >= ?::text::pg_lsn", (lsn,))[0][0]:
            self._noted, self._complete_s = None, since_s
        return self._complete_s

    def follow(self, known: JournalState, timeout_s: float) -> JournalState:
        """See `JournalReader`; by notification, and polling every second."""
        end_s = time.monotonic() + timeout_s
        with readable(self._where):
            notified = self._listen()
            while (state := self.state()) == known and (left_s := end_s - time.monotonic()) > 0:
                if notified:
                    list(self._connected().notifies(timeout=min(left_s, _LOOK_S), stop_after=1))
                else:
                    time.sleep(min(left_s, _LOOK_AGAIN_S))
        return state

    def _listen(self) -> bool:
        """Whether notifications come; earlier ones are unnecessary, because the state is read afterwards."""
        db = self._connected()
        if self._listens is not db:
            ((is_replica,),) = db.execute("SELECT pg_is_in_recovery()").fetchall()
            if is_replica:
                return False
            db.execute(f"LISTEN {CHANNEL}")
            self._listens = db
        return True

    def close(self) -> None:
        """Close the connection."""
        if self._db is not None:
            self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
