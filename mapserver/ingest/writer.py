"""The thread that owns the store: commits batches, folds them, replies; others hand it work."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from mapserver.ingest.backlog import Backlog, WorkRate, size_of
from mapserver.ingest.merge_waits import MergeWaits
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.journal import FencedError
from protocol.errors import QueryError, Refusal
from protocol.queries.answers import ServerAlive
from protocol.wire.messages import Ack, Refused

T = TypeVar("T")
Reply = Callable[[Ack | Refused], None]
_Batch = tuple[Incoming, Reply]
log = logging.getLogger("mapserver.ingest.writer")

COMMIT_EVERY_S = 0.01  # least interval of commits, each of which costs a sync, pages and 0.5 ms
HANGS_S = 30.0  # longest piece of work; a normal one takes less than a second


@dataclass(frozen=True)
class _Work:
    """Work from another thread for the store's owner."""

    work: Callable[[Store], Any]
    result: Future[Any]


class Writer:
    """Owns a Store on its own thread; site, config, location, now_ns, store_id: of the store.

    `submit`, `run`, `look` are thread-safe. waits: for merged rows.
    """

    def __init__(self, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic [s]."""
        self.site, self.config, self.location, self.now_ns = store.site, store.config, store.location, store.now_ns
        self.store_id = store.identity.id
        self._store, self._clock = store, clock
        self._owned = threading.Lock()  # the store, released while its thread waits
        self._turn = threading.Condition()  # guards waiting batches and work
        self._backlog: Backlog[_Batch] = Backlog()
        self._group: list[_Batch] = []  # this turn's unanswered batches
        self._works: deque[_Work] = deque()
        self._pace = WorkRate()
        self._counts: Counter[str] = Counter()  # of what never reaches the store
        self._is_closing = False
        self._ended = ""  # why nothing is accepted any more
        self._busy_since_s: float | None = None
        self._committed_s = -math.inf  # start of the last commit
        self.waits = MergeWaits(store.merged)
        self.failed, self._fenced = False, ""
        self._thread = threading.Thread(target=self._guard, name="writer", daemon=True)
        self._thread.start()

    @property
    def fenced(self) -> str:
        """Why another server has taken over writing, or ""."""
        return self._fenced or self._store.journal.fenced

    @property
    def epoch(self) -> int:
        """Number of this writer in the journal."""
        return self._store.journal.epoch

    def submit(self, incoming: Incoming, reply: Reply) -> None:
        """Submit a batch; `reply` is called on the owner's thread, or at once if refused."""
        with self._turn:
            ended = self._ended
            gone = [] if ended else self._backlog.add(incoming.machine, size_of(incoming.payload), (incoming, reply))
            self._counts[f"refused_{Refusal.OVERLOADED}"] += len(gone)
            retry_after_s = self._pace.retry_after_s(self._backlog.size)
            self._turn.notify()
        if ended:
            reply(Refused(Refusal.STORE, ended))
        for _, overloaded in gone:
            problem = "too many batches are waiting; send this one again later"
            overloaded(Refused(Refusal.OVERLOADED, problem, retry_after_s=retry_after_s))

    def run(self, work: Callable[[Store], T], timeout_s: float = 60.0) -> T:
        """Run `work` on the owner's thread, between groups."""
        result: Future[T] = Future()
        with self._turn:
            if self._ended:
                raise QueryError(Refusal.STORE, self._ended)
            self._works.append(_Work(work, result))
            self._turn.notify()
        return result.result(timeout_s)

    def look(self, work: Callable[[Store], T]) -> T:
        """As `run`, for reads of the map: on the calling thread while the owner is idle."""
        if not (self._backlog or self._works) and self._owned.acquire(blocking=False):
            try:
                if not self._ended:
                    return work(self._store)
            finally:
                self._owned.release()
        return self.run(work)

    def count(self, what: str) -> None:
        """Count a query's outcome."""
        with self._turn:
            self._counts[what] += 1

    def alive(self) -> ServerAlive:
        """Whether batches are accepted, without waiting; QueryError if the owner has ended or hangs."""
        if self._ended:
            raise QueryError(Refusal.STORE, self._ended)
        since_s = self._busy_since_s
        busy_s = 0.0 if since_s is None else max(0.0, self._clock() - since_s)
        if busy_s > HANGS_S:
            problem = f"the writer has been at one piece of work for {busy_s:.0f} s; look at the server's disk and log"
            raise QueryError(Refusal.STORE, problem)
        return ServerAlive(self.store_id, self._store.journalled, self._store.merged, busy_s)

    def info(self) -> dict[str, Any]:
        """State of the store."""
        info = self.run(Store.info)
        commits, commit_s = self._store.commits, self._store.commit_s
        waiting = {"waiting": len(self._backlog), "waiting_bytes": self._backlog.size}
        info["writer"] = {**waiting, "commits": commits, "commit_s": commit_s}
        with self._turn:
            info["counters"] |= +self._counts
        return info

    def close(self) -> None:
        """Finish what waits, snapshot, close; idempotent."""
        self.waits.close()
        with self._turn:
            self._is_closing = True
            self._turn.notify()
        self._thread.join()

    def _guard(self) -> None:
        with self._owned:
            self._own()

    def _own(self) -> None:
        """A bug must end the process: a server that accepts nothing is worse."""
        try:
            self._serve()
        except FencedError as error:
            with self._turn:
                self._fenced = self._ended = error.problem
            log.error("fenced problem=%r", error.problem)
            self._refuse_all(Refusal.NOT_WRITER)
        except Exception:
            with self._turn:  # later requests are refused on submission
                self.failed, self._ended = True, "the server's writer has failed; restart the server"
            log.critical("writer failed", exc_info=True)
            self._refuse_all()
        else:
            self._save_snapshot()
        finally:
            self._store.close()

    def _refuse_all(self, reason: Refusal = Refusal.STORE) -> None:
        """Answer everybody who waits."""
        while self._group or self._backlog:
            for _, reply in self._group:
                reply(Refused(reason, self._ended))
            self._group = self._backlog.take()
        for item in self._works:
            item.result.set_exception(QueryError(Refusal.STORE, self._ended))

    def _serve(self) -> None:
        while self._next():
            self._busy_since_s = self._clock()
            if self._group:
                self._commit()
            for _ in range(len(self._works)):  # later arrivals wait for the next group
                _answer(self._works.popleft(), self._store)
            self._busy_since_s = None

    def _next(self) -> bool:
        """Wait for batches or work; False to end."""
        with self._lent(), self._turn:
            if not (self._backlog or self._works or self._is_closing):
                self._turn.wait()
            is_early = self._backlog and self._gather()
            self._group = [] if is_early else self._backlog.take()
            if self._is_closing and not (self._group or self._works):
                self._ended = "the server is ending"
            return not self._ended

    @contextmanager
    def _lent(self) -> Iterator[None]:
        """Let others read the store meanwhile."""
        self._owned.release()
        try:
            yield
        finally:
            self._owned.acquire()

    def _gather(self) -> bool:
        """Wait for more batches after a recent commit; True if work comes first."""
        wait_s = self._committed_s + COMMIT_EVERY_S - self._clock()
        came = wait_s > 0 and self._turn.wait_for(lambda: self._works or self._is_closing, wait_s)
        return bool(came) and not self._is_closing

    def _commit(self) -> None:
        began_s = self._committed_s = self._clock()
        answers = self._store.commit([incoming for incoming, _ in self._group])
        self._pace.worked(sum(size_of(incoming.payload) for incoming, _ in self._group), self._clock() - began_s)
        self.waits.advance(self._store.merged)
        for answer in answers:
            incoming, reply = self._group.pop(0)
            if isinstance(answer, Refused):
                log.warning("refused machine=%s reason=%s problem=%r", incoming.machine, answer.reason, answer.problem)
            reply(answer)

    def _save_snapshot(self) -> None:
        try:
            self._store.save_snapshot()
        except OSError as error:  # the journal is the truth; only the next start takes longer
            log.error("snapshot failed error=%r", str(error))
        except Exception:  # a bug must be visible
            log.exception("snapshot failed")


def _answer(item: _Work, store: Store) -> None:
    try:
        item.result.set_result(item.work(store))
    except Exception as error:  # for the asking thread
        item.result.set_exception(error)
