"""An index of stamps over a journal, so that reads of a time span skip other rows.

Rows arrive nearly in order of stamps, so the least and greatest stamp of each CHUNK select the extents to read; late
samples add some.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np

from mapserver.journal.journal import JournalReader
from mapserver.journal.rows import LAST, Selection
from protocol.arrays import Bools, Ints

CHUNK = 1024  # rows; reading their extents takes 0.1 ms


class StampIndex:
    """Least and greatest stamp of every CHUNK rows. Thread-safe, with a reader per thread.

    Archived rows are not indexed; their files are.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._chunks: Ints = np.empty((0, 3), np.int64)  # number, least and greatest stamp
        self._known = 0  # last row indexed or archived before

    def stretches(
        self, journal: JournalReader, after: int, until: int, selection: Selection
    ) -> Iterator[tuple[int, int]]:
        """Intervals a < row <= b of after < row <= until that contain all rows with selected stamps, in order.

        Archived rows form one interval.
        """
        chunks, known = self._extended(journal)
        archived = journal.archived_row  # asked last, so that later rows were there for the chunks
        if after < min(archived, until):
            yield after, min(archived, until)
        hit = (chunks[:, 1] <= selection.to_ns) & (chunks[:, 2] >= selection.from_ns)
        for first, last in [*_runs(chunks[hit, 0]), (known, LAST)]:
            if max(first, after, archived) < min(last, until):
                yield max(first, after, archived), min(last, until)

    def next_stamp(self, journal: JournalReader, from_ns: int) -> int | None:
        """The least stamp since from_ns of unarchived rows, or None. It is from_ns if a row spans it."""
        chunks, known = self._extended(journal)
        later = chunks[:, 1] >= from_ns
        across: Bools = ~later & (chunks[:, 2] >= from_ns)
        looked = [journal.least_stamp(*stretch, from_ns) for stretch in [*_runs(chunks[across, 0]), (known, LAST)]]
        return min([*chunks[later, 1].tolist(), *(stamp for stamp in looked if stamp is not None)], default=None)

    def _extended(self, journal: JournalReader) -> tuple[Ints, int]:
        """Chunks and their last row, updated."""
        with self._lock:
            until = journal.last_row // CHUNK * CHUNK
            if until > self._known:
                more = np.array(journal.stamps_by_chunk(self._known, until, CHUNK), np.int64).reshape(-1, 3)
                self._chunks, self._known = np.concatenate([self._chunks, more]), until
            return self._chunks, self._known


def _runs(numbers: Ints) -> list[tuple[int, int]]:
    """Intervals a < row <= b of consecutive chunks."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return [(int(run[0]) * CHUNK, (int(run[-1]) + 1) * CHUNK) for run in runs if len(run)]
