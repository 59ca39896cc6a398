"""History: archive and journal as one, folded on several threads."""

from __future__ import annotations

import ctypes
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence.grid import Grid
from mapserver.evidence.workers import ALONE, Workers
from mapserver.journal.archive import Archive
from mapserver.journal.journal import ArchivedError, JournalQueries
from mapserver.journal.records import checksum_of, record
from mapserver.journal.rows import ALL, LAST, JournalRow, JournalRows, Selection
from protocol.arrays import Table

# only kernels run in parallel; more do not help: lab/results/refold.md
THREADS = min(2, len(os.sched_getaffinity(0)))
PIECE = 16_384  # samples per piece
AHEAD = 24  # pieces read ahead, about one fold's
Samples = tuple[Table, NDArray[np.uint64]]  # with hashes of machine names
T = TypeVar("T")


@dataclass(frozen=True)
class History:
    """All rows of one store. For one thread at a time, like its journal's connection."""

    journal: JournalQueries
    archive: Archive

    def row_checksum(self, row: int) -> int | None:
        """As of a journal, also for archived rows, equal bit for bit."""
        if (checksum := self.journal.row_checksum(row)) is not None or not 0 < row <= self.journal.archived_row:
            return checksum
        return next((checksum_of(record(each)) for each in history_rows(self, row - 1, row)), None)


def read_history(
    history: History, after: int = 0, until: int = LAST, selection: Selection = ALL
) -> Iterator[JournalRows]:
    """Rows after < row <= until in order, once each, even while they move to the archive; in non-empty pieces."""
    while True:
        try:
            for rows in history.journal.read_many(after, until, selection):
                yield rows
                after = int(rows.numbers[-1])
        except ArchivedError as error:
            archived = min(error.archived_row, until)
        else:
            return
        yield from history.archive.read_many(after, archived, selection)
        after = archived


def history_rows(
    history: History, after: int = 0, until: int = LAST, selection: Selection = ALL
) -> Iterator[JournalRow]:
    """As `read_history`, one by one."""
    return chain.from_iterable(read_history(history, after, until, selection))


class _StoppedError(Exception):
    """A fold was cancelled."""


@contextmanager
def lent(count: int) -> Iterator[Workers]:
    """Lend threads to a grid (`Grid.bulk`)."""
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
    """Fold selected samples of rows after < row <= until, and settle the grid.

    Returns False, with an unusable grid, if `stopped`.
    """
    return fold_samples(grid, pieces(read_history(history, after, until, selection), selection), stopped, threads)


def fold_samples(
    grid: Grid,
    pieces: Generator[Samples, None, None],
    stopped: Callable[[], bool] = lambda: False,
    threads: int = THREADS,
) -> bool:
    """As `fold_history`, for any samples."""
    try:
        with lent(threads) as workers, grid.bulk(workers), closing(ahead(pieces) if threads > 1 else pieces) as coming:
            for samples, names in coming:
                grid.fold_all(samples, names)
                if stopped():
                    raise _StoppedError  # skips the regular end, which takes time
    except _StoppedError:
        return False
    return True


def ahead(pieces: Iterator[T]) -> Generator[T, None, None]:
    """Make pieces ahead on another thread."""
    with ThreadPoolExecutor(1, thread_name_prefix="read") as pool:
        try:
            coming = deque(pool.submit(next, pieces, None) for _ in range(AHEAD))
            while (piece := coming.popleft().result()) is not None:
                coming.append(pool.submit(next, pieces, None))
                yield piece
        finally:
            pool.shutdown(cancel_futures=True)


def pieces(history: Iterable[JournalRows], selection: Selection) -> Generator[Samples, None, None]:
    """Samples in short pieces, to save memory on those read ahead."""
    for rows in history:
        samples, names = rows.selected(selection)
        for first in range(0, len(samples), PIECE):
            yield samples[first : first + PIECE], names[first : first + PIECE]


def release_memory() -> None:
    """Return memory freed by a fold, or by making roads, to the system; the C library keeps it per thread."""
    with suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL(None).malloc_trim(0)
