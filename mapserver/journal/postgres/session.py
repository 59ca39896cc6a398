"""The session that may write a journal in PostgreSQL: it holds the lock and is kept alive.

A hanging holder must lose the lock. So the database ends sessions idle for HANGS_S, and a thread, which hangs with its
process, sends signs of life. The session sends only single messages of the simple query protocol, each a transaction:
interrupted anywhere, it counts as idle, whereas PostgreSQL 15 has no timeout inside pipelines or prepared statements.
It reads nothing large: a database waiting for its client is not idle.

A network that acknowledges but drops bytes never fails, so a sign of life unanswered for ANSWER_S ends the session. A
commit may wait longer, for a replica; meanwhile another connection looks for a take-over.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import psycopg

from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.journal.postgres.connection import REPLICAS, connect, line, replica_of
from protocol.errors import StoreError

HANGS_S = 1.5  # silence after which a holder loses the lock
AWAKE_S = 0.3  # interval of signs of life
ANSWER_S = 2 * HANGS_S  # timeout of a sign of life, normally answered at once
LOOK_TURNS = 10  # signs of life between two looks for replicas
LOCK = 0x517E62D1  # advisory lock of journals, per database
FENCED = "SG001"  # SQLSTATE of `advance`
OLDEST = 140_000  # PostgreSQL 14; older ones do not end idle sessions
SET_UP = f"""
SET idle_session_timeout = '{HANGS_S:g}s'; SET idle_in_transaction_session_timeout = '{HANGS_S:g}s';
SET statement_timeout = 0; SET lock_timeout = 0;
SET tcp_user_timeout = {HANGS_S * 1000:.0f}; SET tcp_keepalives_idle = 1; SET tcp_keepalives_interval = 1;
SET tcp_keepalives_count = 2
"""
_SETTINGS = """SELECT current_setting('server_version_num')::int, current_setting('fsync'),
current_setting('full_page_writes'), set_config('synchronous_commit',
    CASE current_setting('synchronous_commit') WHEN 'remote_apply' THEN 'remote_apply' ELSE 'on' END, false)"""
log = logging.getLogger("mapserver.journal.postgres.session")


class WriterSession:
    """A session for the lock and writes; thread-safe.

    lost: why it is unusable, or "". replica: see `JournalQueries`.
    """

    def __init__(self, url: str, where: str, lost: Callable[[], None] = lambda: None) -> None:
        """lost: called repeatedly on another thread, while the session is lost or unanswered."""
        self.lost, self.replica = "", "none"
        self._where, self._on_loss = where, lost
        self._turn, self._ending = threading.Lock(), threading.Event()
        self._warning = ""
        self._asked_s: float | None = None  # start of the pending request
        self._is_sign = False
        try:
            self._db = connect(url, "writer", target_session_attrs="read-write")
        except psycopg.Error as error:
            raise UnwrittenError(where, line(error)) from None
        self._db.add_notice_handler(self._on_notice)
        try:
            self._require_settings()
            self._db.execute(SET_UP)
            self._look_for_replicas()
        except psycopg.Error as error:
            is_lost = self._db.closed
            self._db.close()
            if is_lost:  # the database is shutting down: the caller may wait
                raise UnwrittenError(where, line(error)) from None
            raise StoreError(where, f"is no usable journal: {line(error)}") from None
        except StoreError:
            self._db.close()
            raise
        self._thread = threading.Thread(target=self._stay_awake, name="journal", daemon=True)
        self._thread.start()
        threading.Thread(target=self._watch, name="journal watch", daemon=True).start()

    def take_lock(self) -> bool:
        """Try to become the writer; False if another session is."""
        ((taken,),) = self.run(f"SELECT pg_try_advisory_lock({LOCK})")
        return bool(taken)

    def run(self, query: str | bytes) -> list[tuple[Any, ...]]:
        """Run statements as one transaction; returns the last answer.

        UnwrittenError on failure, unsure if the session was lost.
        """
        with self._turn:
            if self.lost:
                raise UnwrittenError(self._where, self.lost)
            self._warning = ""
            self._asked_s = time.monotonic()
            try:
                cursor = self._db.execute(query)
                while cursor.nextset():
                    pass
                answer = cursor.fetchall() if cursor.description else []
            except psycopg.Error as error:
                if error.sqlstate == FENCED:
                    self.lost = "another server has taken over the journal"
                    raise FencedError(self._where, self.lost) from None
                if is_lost := self._db.closed:
                    self.lost = line(error)
                raise UnwrittenError(self._where, line(error), unsure=is_lost) from None
            finally:
                self._asked_s = None
            if self._warning:  # of a commit that did not wait for its replica
                self._lose(self._warning)
                raise UnwrittenError(self._where, self.lost, unsure=True)
            return answer

    def cut(self) -> None:
        """Interrupt a pending answer; the session is lost. Thread-safe."""
        with suppress(OSError, psycopg.Error), socket.socket(fileno=os.dup(self._db.fileno())) as link:
            link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Release the lock."""
        self._ending.set()  # ends its threads
        in_time = threading.Timer(ANSWER_S, self.cut)
        in_time.daemon = True
        in_time.start()
        with self._turn:
            with suppress(psycopg.Error):
                self._db.execute("SELECT pg_advisory_unlock_all()")  # at once, before the database notices the close
            self._lose("it is closed")
        in_time.cancel()

    def _require_settings(self) -> None:
        """StoreError if acknowledged data might be lost."""
        ((version, fsync, pages, commit),) = self._db.execute(_SETTINGS).fetchall()
        if version < OLDEST:
            raise StoreError(self._where, f"is PostgreSQL {version // 10_000}; a journal needs version 14 or newer")
        for name, value in (("fsync", fsync), ("full_page_writes", pages)):
            if value != "on":
                problem = f"runs with {name} = {value}: a power cut loses what was acknowledged; turn it on"
                raise StoreError(self._where, problem)
        if commit not in ("on", "remote_apply"):
            raise StoreError(self._where, f"keeps synchronous_commit = {commit}; let this user turn it on")

    def _look_for_replicas(self) -> None:
        ((synchronous, replicas),) = self._db.execute(REPLICAS).fetchall()
        self.replica = replica_of(synchronous=synchronous, replicas=replicas)

    def _stay_awake(self) -> None:
        turns = 0
        while not self._ending.wait(AWAKE_S):
            if self.lost:
                self._on_loss()
            elif self._turn.acquire(blocking=False):  # otherwise in use
                turns += 1
                try:
                    self._say_something(look=turns % LOOK_TURNS == 0)
                finally:
                    self._turn.release()

    def _watch(self) -> None:
        """Notice missing answers."""
        while not self._ending.wait(AWAKE_S):
            asked_s = self._asked_s
            if asked_s is None or time.monotonic() - asked_s < ANSWER_S:
                continue
            if self._is_sign:
                self.cut()
            self._on_loss()
            self._ending.wait(ANSWER_S)

    def _say_something(self, *, look: bool) -> None:
        self._asked_s, self._is_sign = time.monotonic(), True
        try:
            self._db.execute("SELECT 1")
            if look:
                self._look_for_replicas()
        except psycopg.Error as error:
            self._lose(line(error))
        finally:
            self._asked_s, self._is_sign = None, False

    def _lose(self, why: str) -> None:
        self.lost = self.lost or why
        if not self._ending.is_set():
            log.error("journal session lost problem=%r", self.lost)
        with suppress(psycopg.Error):
            self._db.close()

    def _on_notice(self, notice: psycopg.errors.Diagnostic) -> None:
        if notice.severity_nonlocalized == "WARNING":
            self._warning = notice.message_primary or "the database warns"
