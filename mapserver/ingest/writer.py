"""The thread that owns the store: it commits batches, folds them, then replies; other threads hand it work."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

from mapserver.ingest.merge_waits import MergeWaits
from mapserver.ingest.store import Incoming, Store
from protocol.errors import QueryError, Refusal
from protocol.wire.messages import Ack, Refused

T = TypeVar("T")
Reply = Callable[[Ack | Refused], None]
log = logging.getLogger("mapserver.ingest.writer")

QUEUE_BATCHES = 256  # so many batches may wait before machines have to send again later; some MB
GROUP_BATCHES = 64  # committed together at most: one sync to disk for all of them
SNAPSHOT_ROWS = 2000  # a burst of so many rows brings the next snapshot forward: the next start would have to fold them


@dataclass(frozen=True)
class _Work:
    """Work of another thread for the one that owns the store."""

    work: Callable[[Store], Any]
    result: Future[Any]


class Writer:
    """Owns a Store on a thread of its own, from here on; site, config, folder, now_ns, store_id: of the store.

    `submit` and `run` may be called from any thread; both return at once or wait for the owner, never touch the store.
    waits: who waits for a row to be merged.
    """

    def __init__(self, store: Store) -> None:
        self.site, self.config, self.folder, self.now_ns = store.site, store.config, store.folder, store.now_ns
        self.store_id = store.identity.id
        self._snapshot_s = self.config.store.snapshot_s
        self._store = store
        self._batches: queue.Queue[tuple[Incoming, Reply] | _Work | None] = queue.Queue()
        self._waiting = threading.Semaphore(QUEUE_BATCHES)
        self._overloaded = 0
        self.waits = MergeWaits(store.merged)
        self.failed = False
        self._snapshots = ThreadPoolExecutor(1, thread_name_prefix="snapshot")
        self._snapshot: Future[None] = Future()
        self._snapshot.set_result(None)
        self._thread = threading.Thread(target=self._guard, name="writer", daemon=True)
        self._thread.start()

    def submit(self, incoming: Incoming, reply: Reply) -> None:
        """Hand in a batch; `reply` is called on the owner's thread, at once here if too many are waiting."""
        if not self._waiting.acquire(blocking=False):
            self._overloaded += 1
            reply(Refused(Refusal.OVERLOADED, "too many batches are waiting; send this one again later"))
            return
        self._batches.put((incoming, reply))

    def run(self, work: Callable[[Store], T], timeout_s: float = 60.0) -> T:
        """Run `work` on the owner's thread, between two groups of batches, and return its result."""
        result: Future[T] = Future()
        self._batches.put(_Work(work, result))
        return result.result(timeout_s)

    def count_refusal(self, reason: str) -> None:
        """Count a refused query, soon: nobody waits for that."""
        self._batches.put(_Work(lambda store: store.counters.update({f"refused_query_{reason}": 1}), Future()))

    def info(self) -> dict[str, Any]:
        """State of the store."""
        info = self.run(Store.info)
        commits, commit_s = self._store.commits, self._store.commit_s
        info["writer"] = {"waiting": self._batches.qsize(), "commits": commits, "commit_s": commit_s}
        if self._overloaded:
            info["counters"][f"refused_{Refusal.OVERLOADED}"] = self._overloaded
        return info

    def close(self) -> None:
        """Finish what is waiting, snapshot, close; once more does nothing."""
        self.waits.close()
        self._batches.put(None)
        self._thread.join()

    def _guard(self) -> None:
        """A bug must end the process visibly: a server that accepts nothing more is worse than none."""
        try:
            self._serve()
        except Exception:
            self.failed = True
            log.critical("writer failed", exc_info=True)
            self._refuse_all()
        else:
            self._snapshot.result()
            self._save_snapshot()
        finally:
            self._snapshots.shutdown()
            self._store.close()

    def _refuse_all(self) -> None:
        """Leave nobody waiting until the process ends."""
        problem = "the server's writer has failed; restart the server"
        while (item := self._batches.get()) is not None:
            if isinstance(item, _Work):
                item.result.set_exception(QueryError(Refusal.STORE, problem))
            else:
                self._waiting.release()
                item[1](Refused(Refusal.STORE, problem))

    def _serve(self) -> None:
        tried_row = self._store.snapshot_row
        next_snapshot_s = time.monotonic() + self._snapshot_s
        while (first := self._next(next_snapshot_s)) is not None:
            if isinstance(first, _Work):
                _answer(first, self._store)
            elif first:
                self._commit_group(first)
            if self._store.merged - tried_row >= SNAPSHOT_ROWS or time.monotonic() >= next_snapshot_s:
                self._save_snapshot()
                tried_row = self._store.merged
                next_snapshot_s = time.monotonic() + self._snapshot_s

    def _next(self, deadline_s: float) -> tuple[Incoming, Reply] | _Work | tuple[()] | None:
        """Return the next piece of work, () when it is time for a snapshot, None to end."""
        try:
            return self._batches.get(timeout=max(0.0, deadline_s - time.monotonic()))
        except queue.Empty:
            return ()

    def _commit_group(self, first: tuple[Incoming, Reply]) -> None:
        group, works, ending = [first], [], False
        while len(group) < GROUP_BATCHES and not ending:
            try:
                item = self._batches.get_nowait()
            except queue.Empty:
                break
            if isinstance(item, _Work):
                works.append(item)
            elif item is None:
                ending = True
            else:
                group.append(item)
        if ending:
            self._batches.put(None)
        answers = self._store.commit([incoming for incoming, _ in group])
        self.waits.advance(self._store.merged)
        for (incoming, reply), answer in zip(group, answers, strict=True):
            self._waiting.release()
            if isinstance(answer, Refused):
                log.warning("refused machine=%s reason=%s problem=%r", incoming.machine, answer.reason, answer.problem)
            reply(answer)
        for item in works:
            _answer(item, self._store)

    def _save_snapshot(self) -> None:
        """Have a snapshot written beside the work; one that is still being written puts the next off."""
        if self._snapshot.done() and (write := self._store.snapshot()):
            self._snapshot = self._snapshots.submit(_written, write)


def _written(write: Callable[[], None]) -> None:
    try:
        write()
    except OSError as error:  # the journal is the truth; a missing snapshot only makes the next start longer
        log.error("snapshot failed error=%r", str(error))
    except Exception:  # a bug; it must not pass unseen, nor keep the last snapshot from being tried
        log.exception("snapshot failed")


def _answer(item: _Work, store: Store) -> None:
    try:
        item.result.set_result(item.work(store))
    except Exception as error:  # handed on to the thread that asked
        item.result.set_exception(error)
