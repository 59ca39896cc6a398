"""Jobs on all cores: processes that start afresh, so that nothing of one run leaks into another."""

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
# One thread for linear algebra per process: matrices are small, and the processor time of a filter is a result.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def each(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Result]]:
    """Do all jobs and yield them with their results as they end; `work` is a function of a module.

    processes: 1 does them in this process. An error, or an interruption, ends with the jobs that are running.
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
    """Do a job; our errors make their own messages, and would not come through a pipe as what they are."""
    try:
        return work(job)
    except SitegridError as error:
        raise SitegridError(str(error)) from None


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever; Ctrl-C ends it without a page of text."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_watch_parent, daemon=True).start()


def _watch_parent() -> None:
    if parent := multiprocessing.parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables that child processes inherit."""
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            del os.environ[name]
        os.environ.update(before)
