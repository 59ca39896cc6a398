"""Waits for merged journal rows: list entries, which hold no thread."""

from __future__ import annotations

import math
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
        self._next_row: float = math.inf  # lowest awaited row
        self._lock = threading.Lock()

    def add(self, row: int, wait_s: float, then: Then) -> bool:
        """Call `then` once the row is merged, or with an error after wait_s; False if it is merged already.

        It runs on the thread that merges or times out, so it must be short. QueryError if too many wait.
        """
        with self._lock:
            if row <= self._merged:
                return False
            if len(self._waiting) >= MOST_WAITING:
                problem = "too many queries wait for journal rows; ask again later"
                raise QueryError(Refusal.OVERLOADED, problem, retry_after_s=2.0)
            self._waiting.append(_Wait(row, wait_s, time.monotonic() + wait_s, then))
            self._next_row = min(self._next_row, row)
            return True

    def advance(self, merged: int) -> None:
        """Note merged rows, and call back."""
        with self._lock:
            self._merged = merged
            due = self._taken(lambda wait: wait.row <= merged) if merged >= self._next_row else []
        for wait in due:
            wait.then(None)

    def time_out(self) -> float:
        """Call back after timeouts; returns the time until the next one [s], or inf."""
        with self._lock:
            now_s = time.monotonic()
            due = self._taken(lambda wait: wait.deadline_s <= now_s)
            next_s = min((wait.deadline_s for wait in self._waiting), default=math.inf)
        for wait in due:
            problem = f"journal row {wait.row} is not merged after {wait.wait_s:g} s; merged is {self._merged}"
            wait.then(QueryError(Refusal.AFTER_TIMEOUT, problem))
        return next_s - now_s

    def close(self) -> None:
        """Drop all waits."""
        with self._lock:
            self._waiting, self._next_row = [], math.inf

    def _taken(self, is_due: Callable[[_Wait], bool]) -> list[_Wait]:
        due = [wait for wait in self._waiting if is_due(wait)]
        if due:
            self._waiting = [wait for wait in self._waiting if not is_due(wait)]
            self._next_row = min((wait.row for wait in self._waiting), default=math.inf)
        return due
