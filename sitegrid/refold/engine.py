"""Executors of a fold's tasks: this process, or Dask workers (dask.distributed) on one or many hosts.

A task is a function and a value, and may run twice: file names identify contents. Dask reschedules tasks of dead
workers. Its endless waits get timeouts here: a worker that ends by `sys.exit` takes its nanny along and is not
replaced.
"""

from __future__ import annotations

import logging
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from importlib import import_module
from typing import Any, Self, TypeVar
from uuid import uuid4

from protocol.errors import ConfigError, SitegridError

T = TypeVar("T")
R = TypeVar("R")
SCHEME = "dask://"
TASK_SAMPLES = 4_000_000  # some seconds; evidence of smaller tasks takes longer to merge than to fold
TRIES = 3  # rounds in a row without progress before giving up
PATIENCE_S = 900.0  # timeout without progress; the largest tasks take half a minute
CONNECT_S = 20.0  # timeout of a scheduler, and of its first worker
ALONE_S = 60.0  # timeout without workers: a stopping worker finishes its task before its successor starts
LOOK_S = 2.0  # between checks of scheduler and workers
LOST = "lost"  # status of a dead worker's task, which another one repeats


class EngineError(SitegridError):
    """Workers are gone or idle."""


class StalledError(Exception):
    """Work stalled; may be retried."""


class Here:
    """Tasks in sequence, in this process; a single one folds everything without merging.

    threads: per task. task_samples: approximate size of a task.
    """

    task_samples = sys.maxsize

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """Results of all tasks in order; done: called with each finished task's number.

        SitegridError if one fails, EngineError without workers.
        """
        results = []
        for number, task in enumerate(tasks):
            results.append(work(task))
            done(number)
        return results


class Cluster:
    """Workers of one Dask scheduler, as a context."""

    threads, task_samples = 1, TASK_SAMPLES

    def __init__(self, address: str = "", jobs: int = 1) -> None:
        """address: dask://HOST:PORT of a scheduler; else `jobs` local workers that end with the context.

        Local ones speak TLS with their own keys, so no other user of the host reaches them.
        """
        option = "--engine" if address else "--jobs"
        if address and not address.startswith(SCHEME):
            raise ConfigError(option, f"{address!r} is no {SCHEME}HOST:PORT of a Dask scheduler")
        try:
            self._dask: Any = import_module("distributed")
        except ModuleNotFoundError:
            raise ConfigError(option, "dask.distributed is not installed: pip install '.[cluster]'") from None
        self._address, self._jobs = address, jobs
        self._who = f"the workers of {address}" if address else "the processes of the fold"
        for name in (name for name in logging.root.manager.loggerDict if name.startswith("distributed")):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # their long messages are one line here
        self._client: Any = None
        self._local: Any = None
        self._killed: type[Exception] = self._dask.scheduler.KilledWorker

    def __enter__(self) -> Self:
        try:
            self._client = self._connected() if self._address else self._started()
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            self.__exit__()
            problem = f"the scheduler at {self._address} has no workers; start some with `dask worker`"
            raise ConfigError("--engine", problem) from None
        return self

    def __exit__(self, *_: object) -> None:
        for opened in (self._client, self._local):
            with suppress(Exception):  # the scheduler may be gone
                opened.close(timeout=CONNECT_S)

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """As `Here.each`; EngineError after TRIES rounds without progress."""
        results: dict[int, R] = {}
        failures = 0
        while left := {number: task for number, task in enumerate(tasks) if number not in results}:
            before = len(results)
            try:
                self._do(work, left, results, done)
            except (StalledError, self._killed) as error:
                failures = failures + 1 if len(results) == before else 1
                if failures >= TRIES:
                    why = f"did nothing for {PATIENCE_S:g} s" if isinstance(error, StalledError) else "died of one task"
                    advice = "if that is for want of memory, give fewer --jobs, or workers with more"
                    raise EngineError(f"{self._who} {why}, {failures} times in a row; {advice}") from None
        return [results[number] for number in range(len(tasks))]

    def _connected(self) -> Any:
        place = self._address.removeprefix(SCHEME)
        host, _, port = place.rpartition(":")
        try:
            socket.create_connection((host, int(port)), CONNECT_S).close()
            return _within(CONNECT_S, lambda: self._dask.Client(f"tcp://{place}", timeout=CONNECT_S))
        except (OSError, ValueError, OverflowError):  # TimeoutError is an OSError
            problem = f"no Dask scheduler answers at {self._address}; start one with `dask scheduler`"
            raise ConfigError("--engine", problem) from None

    def _started(self) -> Any:
        """A client of a scheduler in this process, with workers that die with it."""
        options: dict[str, Any] = {"memory_limit": 0, "silence_logs": logging.CRITICAL, "security": True}
        options["dashboard_address"] = "127.0.0.1:0"  # cannot be disabled; its usual port may be taken
        known = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited by children: Ctrl-C is only ours
        try:
            self._local = self._dask.LocalCluster(n_workers=self._jobs, threads_per_worker=1, **options)
        finally:
            signal.signal(signal.SIGINT, known)
        self._local.adapt(minimum=self._jobs, maximum=self._jobs, interval="1 s")  # replaces workers whose nanny ended
        return self._dask.Client(self._local, timeout=CONNECT_S)

    def _do(
        self, work: Callable[[T], R], tasks: Mapping[int, T], results: dict[int, R], done: Callable[[int], None]
    ) -> None:
        """Run tasks to the end; StalledError without progress."""
        run = uuid4().hex[:8]  # hung tasks are reassigned under new names
        waiting: dict[Any, int] = {}
        for number, task in tasks.items():
            key = f"{work.__name__}-{run}-{number}"
            waiting[self._client.submit(attempt, work, task, key=key, pure=False)] = number
        try:
            while waiting:
                for future in self._finished(list(waiting)):
                    if future.status == LOST:
                        continue
                    number = waiting.pop(future)
                    results[number] = self._result(future)
                    done(number)
        except (OSError, self._dask.client.FuturesCancelledError):  # connection closed, or cancelled elsewhere
            raise self._gone() from None
        finally:
            with suppress(Exception):  # the scheduler may be gone
                self._client.cancel(list(waiting), force=True)

    def _finished(self, futures: list[Any]) -> list[Any]:
        """Some finished futures; StalledError after PATIENCE_S, EngineError without workers."""
        began_s = alone_s = time.monotonic()
        while True:
            with suppress(TimeoutError):
                return list(self._dask.wait(futures, timeout=LOOK_S, return_when="FIRST_COMPLETED").done)
            now_s = time.monotonic()
            if self._client.status != "running":
                raise self._gone()
            if self._client.nthreads():  # by worker
                alone_s = now_s
            if now_s - alone_s > ALONE_S:
                raise EngineError(f"{self._who} are gone, and no others come; start some")
            if now_s - began_s > PATIENCE_S:
                raise StalledError

    def _result(self, future: Any) -> Any:
        if future.status == "cancelled":
            raise self._gone()
        if future.status == "finished":
            return future.result(timeout=CONNECT_S)
        error = future.exception(timeout=CONNECT_S)
        if isinstance(error, (SitegridError, self._killed)):  # several workers died on this task
            raise error
        raise EngineError(f"one of {self._who} failed: {type(error).__name__}: {error}")

    def _gone(self) -> EngineError:
        return EngineError(f"the Dask scheduler at {self._address or 'this process'} is gone")


Engine = Here | Cluster


def attempt(work: Callable[[T], R], task: T) -> R:
    """Run a task in any process; errors become plain ones that survive pickling."""
    try:
        return work(task)
    except (SitegridError, OSError, MemoryError) as error:
        raise SitegridError(str(error) or "out of memory") from None


def _within(seconds: float, work: Callable[[], T]) -> T:
    """Result of work, or TimeoutError: clients connect to silent ports forever."""
    future: Future[T] = Future()

    def do() -> None:
        try:
            future.set_result(work())
        except Exception as error:  # re-raised for the waiting thread
            future.set_exception(error)

    threading.Thread(target=do, name="connect", daemon=True).start()
    return future.result(seconds)
