"""Waits for merged journal rows: list entries, which hold no thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from protocol.errors import QueryError, Refusal

MOST_WAITING = 1000  # waiting queries, a few kB each
Then = Callable[[QueryError | None], None]


@dataclass(frozen=True)
class _Wait:
    row: int
    wait_s: float
    deadline_s: float
    then: Then


class MergeWaits:
    """Calls back when a row is merged, or on timeout. Thread-safe."""

    def __init__(self, merged: int) -> None:
        self._merged = merged
        self._waiting: list[_Wait] = []
        self._next_row: float = float("inf")  # lowest awaited row
        self._closed = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="waits", daemon=True)
        self._thread.start()

    def add(self, row: int, wait_s: float, then: Then) -> None:
        """Call `then` once the row is merged, maybe at once; with an error after wait_s. QueryError if overloaded."""
        with self._news:
            if is_waiting := row > self._merged:
                if len(self._waiting) >= MOST_WAITING:
                    problem = "too many queries wait for journal rows; ask again later"
                    raise QueryError(Refusal.OVERLOADED, problem, retry_after_s=2.0)
                self._waiting.append(_Wait(row, wait_s, time.monotonic() + wait_s, then))
                self._next_row = min(self._next_row, row)
                self._news.notify()
        if not is_waiting:
            then(None)

    def advance(self, merged: int) -> None:
        """Note merged rows. Only wakes the thread, because the store's owner has no time."""
        with self._news:
            self._merged = merged
            if merged >= self._next_row:
                self._news.notify()

    def close(self) -> None:
        """Drop all waits."""
        with self._news:
            self._closed = True
            self._waiting.clear()
            self._news.notify()
        self._thread.join()

    def _run(self) -> None:
        while (due := self._next_due()) is not None:
            for wait in due:
                problem = f"journal row {wait.row} is not merged after {wait.wait_s:g} s; merged is {self._merged}"
                wait.then(None if wait.row <= self._merged else QueryError(Refusal.AFTER_TIMEOUT, problem))

    def _next_due(self) -> list[_Wait] | None:
        """Block until some waits are over, and take them; None at the end."""
        with self._news:
            while not self._closed:
                now_s = time.monotonic()
                due = [wait for wait in self._waiting if wait.row <= self._merged or wait.deadline_s <= now_s]
                if due:
                    self._waiting = [wait for wait in self._waiting if wait not in due]
                    self._next_row = min((wait.row for wait in self._waiting), default=float("inf"))
                    return due
                deadline_s = min((wait.deadline_s for wait in self._waiting), default=None)
                self._news.wait(deadline_s and max(0.0, deadline_s - now_s))
        return None
