"""Long folds of a history on several threads: after a decision about a machine, and when a store is opened."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

from mapserver.evidence.grid import Grid
from mapserver.evidence.workers import ALONE, Workers
from mapserver.journal.history import History, read_history
from mapserver.journal.reader import LAST
from mapserver.journal.rows import ALL, Selection

# The kernels run beside each other, what is Python between them does not.
THREADS = min(2, len(os.sched_getaffinity(0)))


class _StoppedError(Exception):
    """A fold is not wanted any more."""


@contextmanager
def lent(count: int) -> Iterator[Workers]:
    """Lend so many threads to a grid (`Grid.bulk`)."""
    if count == 1:
        yield ALONE
        return
    with ThreadPoolExecutor(count, thread_name_prefix="fold") as pool:
        yield Workers(count, pool.map)


def fold_history(
    grid: Grid,
    history: History,
    after: int = 0,
    until: int = LAST,
    selection: Selection = ALL,
    stopped: Callable[[], bool] = lambda: False,
    threads: int = THREADS,
) -> bool:
    """Fold the selected samples of rows after < row <= until, and settle the grid.

    Whether it came to the end: where `stopped` says so it ends early, and the grid is of no use.
    """
    try:
        with lent(threads) as workers, grid.bulk(workers):
            for rows in read_history(history, after, until, selection):
                grid.fold_all(*rows.selected(selection))
                if stopped():
                    raise _StoppedError  # past what ends a fold in order, which takes its time
    except _StoppedError:
        return False
    return True


def release_memory() -> None:
    """Give back to the system what a long fold has freed: the C library would keep it, for each thread apart."""
    with suppress(OSError, AttributeError):  # glibc has it
        ctypes.CDLL(None).malloc_trim(0)
