"""Who does the tasks of a fold: this process, processes on this host, or a cluster (cluster.py).

A task is a function and a value, and it may be done twice: what it writes has a name that says what is in it. So
whoever dies is replaced, and its tasks are done again.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

from protocol.errors import SitegridError

T = TypeVar("T")
R = TypeVar("R")
PATIENCE_S = 900.0  # without any task done: the largest take half a minute
TASK_SAMPLES = 4_000_000  # some seconds; the evidence of smaller ones would take longer to merge than to fold
TRIES = 3  # of a task, and of all processes at once, before a fold is given up
_PR_SET_PDEATHSIG = 1


class EngineError(SitegridError):
    """Those who do the work are gone, or do not do it."""


class StalledError(Exception):
    """The work did not go on, and may be tried again. why: what happened; advice: for who gives up."""

    def __init__(self, why: str, advice: str) -> None:
        super().__init__(why)
        self.why, self.advice = why, advice


class Engine(Protocol):
    """Does tasks."""

    @property
    def threads(self) -> int:
        """How many threads one task may use."""
        ...

    @property
    def task_samples(self) -> int:
        """How many samples one task folds, about."""
        ...

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """Results of all tasks, in their order; done: is told the number of each that is done, here.

        Raises SitegridError where one fails, EngineError where nobody does them.
        """
        ...


@dataclass(frozen=True)
class Failure:
    """What a task has to say for itself: errors do not all survive the way to another process."""

    text: str


@dataclass(frozen=True)
class Success(Generic[R]):
    """What came of a task."""

    value: R


class Here:
    """One task after the other, in the process that asks; a single one folds all, and nothing has to be merged."""

    task_samples = sys.maxsize

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """See Engine."""
        results = []
        for number, task in enumerate(tasks):
            results.append(work(task))
            done(number)
        return results


class Processes:
    """Processes on this host, which end with it; use it as a context. jobs: how many at most."""

    threads, task_samples = 1, TASK_SAMPLES

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None
        self._others: set[Any] = set()  # children that are not of the pool

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """See Engine."""

        def attempt_all(left: Mapping[int, T], results: dict[int, R]) -> None:
            try:
                self._do(work, left, results, done)
            except (BrokenProcessPool, TimeoutError) as error:
                self._end()
                why = "were killed" if isinstance(error, BrokenProcessPool) else f"did nothing for {PATIENCE_S:g} s"
                advice = "if that is for want of memory, give fewer --jobs"
                raise StalledError(f"processes of the fold {why}", advice) from None

        return in_turns(tasks, attempt_all)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _do(
        self, work: Callable[[T], R], tasks: Mapping[int, T], results: dict[int, R], done: Callable[[int], None]
    ) -> None:
        """Do tasks until all are done; BrokenProcessPool where a process dies, TimeoutError where nothing is done."""
        pool = self._begun()
        waiting: dict[Future[Success[R] | Failure], int] = {
            pool.submit(attempt, work, task): number for number, task in tasks.items()
        }
        try:
            while waiting:
                finished, _ = wait(waiting, PATIENCE_S, FIRST_COMPLETED)
                if not finished:
                    raise TimeoutError
                for future in finished:
                    number = waiting.pop(future)
                    results[number] = opened(future.result())
                    done(number)
        finally:
            for future in waiting:
                future.cancel()

    def _begun(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._others = set(multiprocessing.active_children())
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._jobs, spawn, _begin, (os.getpid(),))
        return self._pool

    def _end(self) -> None:
        """End the processes, whatever they do: what they write has its name only once it is whole."""
        if self._pool:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - self._others:
                child.kill()
                child.join()
            self._pool = None


def in_turns(tasks: Sequence[T], attempt_all: Callable[[Mapping[int, T], dict[int, R]], None]) -> list[R]:
    """Results of tasks, in their order; EngineError after TRIES turns in a row in which none was done.

    attempt_all: does what is left, by number, and enters each result; StalledError where that does not go on.
    """
    results: dict[int, R] = {}
    failures = 0
    while left := {number: task for number, task in enumerate(tasks) if number not in results}:
        before = len(results)
        try:
            attempt_all(left, results)
        except StalledError as error:
            failures = failures + 1 if len(results) == before else 1
            if failures >= TRIES:
                raise EngineError(f"{error.why}, {failures} times in a row; {error.advice}") from None
    return [results[number] for number in range(len(tasks))]


def attempt(work: Callable[[T], R], task: T) -> Success[R] | Failure:
    """Do a task, in whichever process this is."""
    try:
        return Success(work(task))
    except (SitegridError, OSError, MemoryError) as error:
        return Failure(str(error) or "out of memory")


def opened(result: Success[R] | Failure) -> R:
    """What came of a task; SitegridError where it failed."""
    if isinstance(result, Failure):
        raise SitegridError(result.text)
    return result.value


def _begin(parent: int) -> None:
    """Begin a process: Ctrl-C is its parent's business, and it does not outlive that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError, AttributeError):  # Linux has it
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
