"""Threads that answer queries, within a budget of bytes for all answers that wait or are in work.

The budget is one for all: Zenoh does not tell who asks.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable, Mapping

from protocol.errors import QueryError, Refusal

END_S = 1.0  # at the end, what is in work may take so long; nobody waits for an answer longer than for the end
MIN_RETRY_S, MAX_RETRY_S = 0.5, 30.0
Work = tuple[int, Callable[[], None]]  # size, what to do
Order = Callable[[Mapping[int, Work]], int]  # which of those that wait is next
log = logging.getLogger("mapserver.query.answer_pool")


class AnswerPool:
    """Work for some threads.

    The first takes the smallest answer that waits, so that small ones pass large ones; further threads take the oldest,
    so that large ones have their turn.
    """

    def __init__(self, name: str, threads: int, budget: int) -> None:
        """budget: of the sizes of all answers that wait or are in work, in the unit that callers choose."""
        self._budget, self._size = budget, 0
        self._waiting: dict[int, Work] = {}  # by number, the oldest first
        self._numbers = itertools.count()
        self._mean_s = 0.0  # of an answer
        self._closed = False
        self._news = threading.Condition()
        self._threads = [
            threading.Thread(target=self._run, args=(order,), name=f"{name}-{number}", daemon=True)
            for number, order in enumerate([_smallest, *[_oldest] * (threads - 1)])
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, size: int, work: Callable[[], None]) -> None:
        """Have `work` done by a thread; QueryError if the budget is spent."""
        with self._news:
            if self._size + size > self._budget:
                expected_s = self._mean_s * len(self._waiting) / len(self._threads)
                retry_s = round(min(max(expected_s, MIN_RETRY_S), MAX_RETRY_S), 1)
                raise QueryError(Refusal.OVERLOADED, "the server has too many queries to answer", retry_s)
            self._size += size
            self._waiting[next(self._numbers)] = size, work
            self._news.notify()

    def close(self) -> None:
        """Drop what waits, and let what is in work end."""
        with self._news:
            self._closed = True
            self._waiting.clear()
            self._news.notify_all()
        end_s = time.monotonic() + END_S
        for thread in self._threads:
            thread.join(max(0.0, end_s - time.monotonic()))

    def _run(self, order: Order) -> None:
        while (taken := self._take(order)) is not None:
            (size, work), began_s = taken, time.monotonic()
            try:
                work()
            except Exception:  # a bug must not end the thread
                log.exception("answer failed")
            del taken, work  # the query with it: nobody is left to wait for an answer
            with self._news:
                self._size -= size
                self._mean_s += 0.1 * (time.monotonic() - began_s - self._mean_s)

    def _take(self, order: Order) -> Work | None:
        with self._news:
            while not (self._waiting or self._closed):
                self._news.wait()
            if self._closed:
                return None
            return self._waiting.pop(order(self._waiting))


def _smallest(waiting: Mapping[int, Work]) -> int:
    return min(waiting, key=lambda number: (waiting[number][0], number))


def _oldest(waiting: Mapping[int, Work]) -> int:
    return next(iter(waiting))
