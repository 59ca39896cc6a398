"""The one session that may write a journal in PostgreSQL: it holds the journal's lock, and is kept awake.

A holder that hangs must lose the lock with nobody's help. So the database ends a session that is idle for HANGS_S, and
a thread of the holder, which hangs with it, says something more often than that. This needs two things. All that
the session ever sends is single messages of the simple query protocol, each a transaction of its own: whoever stops in
the middle of one leaves a session that is idle for the database, while between the messages of a pipeline or of a
prepared statement no time limit of PostgreSQL 15 runs. And nothing large is read on it: a database that waits until its
answer is taken is not idle either.

A network that swallows bytes, with something in it that acknowledges them, never fails by itself. So a sign of life
that has no answer for ANSWER_S gives the session up. A commit may wait longer, for a replica; then the holder looks by
another connection whether it was replaced.
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

HANGS_S = 1.5  # a holder that says nothing for so long has lost the lock
AWAKE_S = 0.3  # between two signs of life
ANSWER_S = 2 * HANGS_S  # for a sign of life; the database answers at once
LOOK_TURNS = 10  # signs of life between two looks for replicas
LOCK = 0x517E62D1  # of journals; advisory locks are those of one database
FENCED = "SG001"  # SQLSTATE of `advance`
OLDEST = 140_000  # before version 14 no session ends for being idle
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
    """A session for the lock and for writes; for any thread, one at a time.

    lost: why it cannot be used any more, empty while it can. replica: see `JournalQueries`.
    """

    def __init__(self, url: str, where: str, lost: Callable[[], None] = lambda: None) -> None:
        """lost: is called, on a thread of its own, again and again while the session is lost or has no answer."""
        self.lost, self.replica = "", "none"
        self._where, self._on_loss = where, lost
        self._turn, self._ending = threading.Lock(), threading.Event()
        self._warning = ""
        self._asked_s: float | None = None  # since when an answer is waited for
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
            if is_lost:  # as where the database goes down: who waits for it goes on waiting
                raise UnwrittenError(where, line(error)) from None
            raise StoreError(where, f"is no usable journal: {line(error)}") from None
        except StoreError:
            self._db.close()
            raise
        self._thread = threading.Thread(target=self._stay_awake, name="journal", daemon=True)
        self._thread.start()
        threading.Thread(target=self._watch, name="journal watch", daemon=True).start()

    def take_lock(self) -> bool:
        """Become the journal's writer; whether no other session is."""
        ((taken,),) = self.run(f"SELECT pg_try_advisory_lock({LOCK})")
        return bool(taken)

    def run(self, query: str | bytes) -> list[tuple[Any, ...]]:
        """Run statements as one transaction; what the last one answers.

        UnwrittenError where it fails, unsure where the session was lost with the answer.
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
            if self._warning:  # of a commit that was not waited for until the replica had it
                self._lose(self._warning)
                raise UnwrittenError(self._where, self.lost, unsure=True)
            return answer

    def cut(self) -> None:
        """Have whoever waits for an answer stop that: the session is lost. For any thread."""
        with suppress(OSError, psycopg.Error), socket.socket(fileno=os.dup(self._db.fileno())) as link:
            link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Let go of the lock."""
        self._ending.set()  # its threads end by themselves
        in_time = threading.Timer(ANSWER_S, self.cut)
        in_time.daemon = True
        in_time.start()
        with self._turn:
            with suppress(psycopg.Error):
                self._db.execute("SELECT pg_advisory_unlock_all()")  # now, not once the database sees that it is closed
            self._lose("it is closed")
        in_time.cancel()

    def _require_settings(self) -> None:
        """StoreError where what it acknowledges may be lost."""
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
            elif self._turn.acquire(blocking=False):  # else it is in use, or a batch is waited for
                turns += 1
                try:
                    self._say_something(look=turns % LOOK_TURNS == 0)
                finally:
                    self._turn.release()

    def _watch(self) -> None:
        """Notice that no answer comes."""
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
