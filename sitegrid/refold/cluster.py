"""A cluster that does the tasks of a fold: workers of a Dask scheduler (dask.distributed).

Dask finds out that a worker is gone and has its tasks done by others. What it does not find out is time-limited here:
a worker that ends in order, say by `sys.exit`, takes its nanny along, and none comes in its place.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, Self, TypeVar
from uuid import uuid4

from protocol.errors import ConfigError
from sitegrid.refold.engine import PATIENCE_S, TASK_SAMPLES, TRIES, EngineError, StalledError, attempt, in_turns, opened

T = TypeVar("T")
R = TypeVar("R")
SCHEME = "dask://"
CONNECT_S = 20.0  # for a scheduler to answer, and for its first worker
ALONE_S = 60.0  # without any worker: one that is asked to end finishes its task first, and then another one starts
LOOK_S = 2.0  # between two looks whether somebody is there at all: Dask waits for ever for a worker
LOST = "lost"  # with the worker that had it, and done again by another


class Cluster:
    """Workers of one scheduler; use it as a context. address: dask://HOST:PORT."""

    threads, task_samples = 1, TASK_SAMPLES

    def __init__(self, address: str) -> None:
        if not address.startswith(SCHEME):
            raise ConfigError("--engine", f"{address!r} is no {SCHEME}HOST:PORT of a Dask scheduler")
        try:
            self._dask: Any = import_module("distributed")
        except ModuleNotFoundError:
            raise ConfigError("--engine", "dask.distributed is not installed: pip install '.[cluster]'") from None
        self._address = address
        for name in (name for name in logging.root.manager.loggerDict if name.startswith("distributed")):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say at length is one line here
        self._client: Any = None
        self._killed: type[Exception] = self._dask.scheduler.KilledWorker

    def __enter__(self) -> Self:
        place = self._address.removeprefix(SCHEME)
        host, _, port = place.rpartition(":")
        try:
            socket.create_connection((host, int(port)), CONNECT_S).close()
            self._client = _within(CONNECT_S, lambda: self._dask.Client(f"tcp://{place}", timeout=CONNECT_S))
        except (OSError, ValueError, OverflowError):  # TimeoutError is an OSError
            problem = f"no Dask scheduler answers at {self._address}; start one with `dask scheduler`"
            raise ConfigError("--engine", problem) from None
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            self.__exit__()
            problem = f"the scheduler at {self._address} has no workers; start some with `dask worker`"
            raise ConfigError("--engine", problem) from None
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # of a scheduler that is gone
            self._client.close(timeout=CONNECT_S)

    def each(self, work: Callable[[T], R], tasks: Sequence[T], done: Callable[[int], None] = lambda _: None) -> list[R]:
        """See Engine."""

        def attempt_all(left: Mapping[int, T], results: dict[int, R]) -> None:
            try:
                self._do(work, left, results, done)
            except (TimeoutError, self._killed) as error:
                why = f"did nothing for {PATIENCE_S:g} s" if isinstance(error, TimeoutError) else "died of one task"
                advice = "if that is for want of memory, give them more"
                raise StalledError(f"the workers of {self._address} {why}", advice) from None

        return in_turns(tasks, attempt_all)

    def _do(
        self, work: Callable[[T], R], tasks: Mapping[int, T], results: dict[int, R], done: Callable[[int], None]
    ) -> None:
        """Do tasks until all are done; TimeoutError where none is done for a while."""
        run = uuid4().hex[:8]  # a task that hangs is given to others under another name
        waiting: dict[Any, int] = {}
        for number, task in tasks.items():
            key = f"{work.__name__}-{run}-{number}"
            future = self._client.submit(attempt, work, task, key=key, pure=False, retries=TRIES)
            waiting[future] = number
        try:
            while waiting:
                for future in self._finished(list(waiting)):
                    if future.status == LOST:
                        continue
                    number = waiting.pop(future)
                    results[number] = opened(self._result(future))
                    done(number)
        except TimeoutError:
            raise
        except (OSError, self._dask.client.FuturesCancelledError):  # its connection is closed, or it was another's
            raise self._gone() from None
        finally:
            with suppress(Exception):  # of a scheduler that is gone
                self._client.cancel(list(waiting), force=True)

    def _finished(self, futures: list[Any]) -> list[Any]:
        """Some that are finished; TimeoutError where there are none for long, EngineError where nobody does them."""
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
                raise EngineError(f"the workers of {self._address} are gone, and no other comes; start some")
            if now_s - began_s > PATIENCE_S:
                raise TimeoutError

    def _result(self, future: Any) -> Any:
        if future.status == "cancelled":
            raise self._gone()
        if future.status == "finished":
            return future.result(timeout=CONNECT_S)
        error = future.exception(timeout=CONNECT_S)
        if isinstance(error, self._killed):  # several workers died while they did this task
            raise error
        raise EngineError(f"a worker of {self._address} failed: {type(error).__name__}: {error}")

    def _gone(self) -> EngineError:
        return EngineError(f"the Dask scheduler at {self._address} is gone")


def _within(seconds: float, work: Callable[[], T]) -> T:
    """What comes of work; TimeoutError in the end: to a port that says nothing a client connects for ever."""
    results: list[T | Exception] = []

    def do() -> None:
        try:
            results.append(work())
        except Exception as error:  # whatever it is, it is raised where it is waited for
            results.append(error)

    thread = threading.Thread(target=do, name="connect", daemon=True)
    thread.start()
    thread.join(seconds)
    if not results:
        raise TimeoutError
    if isinstance(results[0], Exception):
        raise results[0]
    return results[0]
