"""Which stretches of a journal hold which stamps, so that a read of some hours passes over all others.

Rows come in nearly in the order of their stamps. So the least and greatest stamp of every CHUNK rows tell which extents
to look at; for a sample that comes in late, these are some more.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np

from mapserver.journal.journal import JournalReader
from mapserver.journal.rows import LAST, Selection
from protocol.arrays import Bools, Ints

CHUNK = 1024  # rows: a look through their extents takes 0.1 ms


class StampIndex:
    """Least and greatest stamp of every CHUNK rows of one journal; for any thread, each with a reader of its own.

    Where an answer is about archived rows as well, that is said; their files have such an index themselves.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._chunks: Ints = np.empty((0, 3), np.int64)  # number, least and greatest stamp
        self._known = 0  # rows up to this one are in it, or were archived before

    def stretches(
        self, journal: JournalReader, after: int, until: int, selection: Selection
    ) -> Iterator[tuple[int, int]]:
        """Stretches a < row <= b of after < row <= until, in order, beside which no row has a selected stamp.

        All that are archived are one stretch.
        """
        chunks, known = self._extended(journal)
        archived = journal.archived_row  # asked last: all rows beyond it were there when the chunks were looked at
        if after < min(archived, until):
            yield after, min(archived, until)
        hit = (chunks[:, 1] <= selection.to_ns) & (chunks[:, 2] >= selection.from_ns)
        for first, last in [*_runs(chunks[hit, 0]), (known, LAST)]:
            if max(first, after, archived) < min(last, until):
                yield max(first, after, archived), min(last, until)

    def next_stamp(self, journal: JournalReader, from_ns: int) -> int | None:
        """The least stamp from `from_ns` on of all rows that are not archived; None for none.

        Of a row that reaches across `from_ns`, this is `from_ns`.
        """
        chunks, known = self._extended(journal)
        later = chunks[:, 1] >= from_ns
        across: Bools = ~later & (chunks[:, 2] >= from_ns)
        looked = [journal.least_stamp(*stretch, from_ns) for stretch in [*_runs(chunks[across, 0]), (known, LAST)]]
        return min([*chunks[later, 1].tolist(), *(stamp for stamp in looked if stamp is not None)], default=None)

    def _extended(self, journal: JournalReader) -> tuple[Ints, int]:
        """Chunks, and the last row that is in them, with all that were filled meanwhile."""
        with self._lock:
            until = journal.last_row // CHUNK * CHUNK
            if until > self._known:
                more = np.array(journal.stamps_by_chunk(self._known, until, CHUNK), np.int64).reshape(-1, 3)
                self._chunks, self._known = np.concatenate([self._chunks, more]), until
            return self._chunks, self._known


def _runs(numbers: Ints) -> list[tuple[int, int]]:
    """Chunks that follow each other as stretches a < row <= b."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return [(int(run[0]) * CHUNK, (int(run[-1]) + 1) * CHUNK) for run in runs if len(run)]
