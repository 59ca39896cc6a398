"""Parallel jobs in fresh processes, so that runs do not influence each other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar

from protocol.errors import SitegridError

Job = TypeVar("Job")
Result = TypeVar("Result")
# One linear algebra thread per process: matrices are small, and CPU time of filters is a result.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def cores() -> int:
    """Usable cores."""
    return len(os.sched_getaffinity(0))


def each(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Result]]:
    """Do all jobs; yields results as they end. `work`: module-level.

    processes: 1: in this process. Errors and interrupts end after the running jobs.
    """
    if processes == 1 or len(jobs) < 2:
        yield from ((job, work(job)) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    count = min(processes, len(jobs))
    with environment(ONE_THREAD), ProcessPoolExecutor(count, context, _end_with_parent) as pool:
        futures = {pool.submit(_guarded, work, job): job for job in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _guarded(work: Callable[[Job], Result], job: Job) -> Result:
    """Our errors do not survive a pipe with their own types."""
    try:
        return work(job)
    except SitegridError as error:
        raise SitegridError(str(error)) from None


def _end_with_parent() -> None:
    """Workers of a killed parent would wait forever; Ctrl-C ends them silently."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_watch_parent, daemon=True).start()


def _watch_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for child processes."""
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            del os.environ[name]
        os.environ.update(before)
