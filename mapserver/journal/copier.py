"""Copies of samples into a new journal, from several sources in the order of reception, each sample once."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from heapq import merge
from operator import itemgetter
from typing import Any

import numpy as np

from mapserver.journal.journal import Journal
from mapserver.journal.rows import LAST, Admission, JournalRow, Selection, SpoolKey, Watermark
from protocol.arrays import Bools
from protocol.errors import StoreError
from protocol.wire.messages import SampleBatch


def merged(sources: Sequence[tuple[str, int, Iterator[JournalRow]]]) -> Iterator[tuple[str, JournalRow]]:
    """Rows of several sources, each in row order, in the order of reception; with the name of their source.

    sources: names, when the first row was received, and the rows; these are not touched before their time comes, so
    that thousands of files may follow each other.
    """

    def keyed(
        name: str, first_ns: int, rows: Iterator[JournalRow]
    ) -> Iterator[tuple[tuple[Any, ...], str, JournalRow | None]]:
        yield (first_ns,), name, None
        for row in rows:
            yield (row.received_ns, row.machine, row.spool_id, row.first_seq, len(row.rows)), name, row

    for _, name, row in merge(*(keyed(*source) for source in sources), key=itemgetter(0)):
        if row:
            yield name, row


class Copier:
    """Copies samples to a new journal, each once, with the identity that they have.

    kept: samples by spool. excluded: how many, by reason: their machine, their time, or that they came twice.
    """

    def __init__(self, journal: Journal, frame: str, selection: Selection) -> None:
        self.kept: Counter[SpoolKey] = Counter()
        self.excluded: Counter[str] = Counter(machine=0, time=0, twice=0)
        self._journal = journal
        self._frame = frame
        self._selection = selection
        self._reached: Counter[SpoolKey] = Counter()
        self._there: dict[SpoolKey, list[tuple[int, int, int]]] = {}  # first seq, last seq, row; in order

    def add(self, origin: str, row: JournalRow) -> None:
        """Write the selected samples of a row into the open transaction.

        origin: where the row is from, for the error. StoreError where a sample is there with other content.
        """
        spool = (row.machine, row.spool_id)
        self._reached[spool] = max(self._reached[spool], row.first_seq + len(row.rows) - 1)
        if row.machine in self._selection.without:
            self.excluded["machine"] += len(row.rows)
            return
        stamps = row.rows["stamp_ns"]
        in_time = (stamps >= self._selection.from_ns) & (stamps <= self._selection.to_ns)
        new = self._are_new(origin, row)
        self.excluded["time"] += int((~in_time).sum())
        self.excluded["twice"] += int((in_time & ~new).sum())
        edges = np.flatnonzero(np.diff(in_time & new, prepend=False, append=False)).tolist()
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            self._write(row, first, end)

    def finish(self, reached: Mapping[SpoolKey, int]) -> None:
        """Write the watermarks into the open transaction: machines go on where they are, excluded samples are lost.

        reached: further watermarks, of spools whose rows may not have been read.
        """
        for spool, seq in reached.items():
            self._reached[spool] = max(self._reached[spool], seq)
        for spool, seq in self._reached.items():
            newest_ns = self._journal.watermark(*spool).newest_ns
            self._journal.put_watermark(*spool, Watermark(seq, seq - self.kept[spool], newest_ns))

    def _are_new(self, origin: str, row: JournalRow) -> Bools:
        """Which samples of a row are not there yet, however they were cut."""
        there = self._there.get((row.machine, row.spool_id), [])
        new: Bools = np.ones(len(row.rows), np.bool_)
        last = row.first_seq + len(row.rows) - 1
        for at in range(bisect_right(there, (last, LAST, 0)) - 1, -1, -1):
            old_first, old_last, number = there[at]
            if old_last < row.first_seq:
                break
            old = next(self._journal.read(number - 1, number)).rows
            for seq in range(max(row.first_seq, old_first), min(last, old_last) + 1):
                if row.rows[seq - row.first_seq].tobytes() != old[seq - old_first].tobytes():
                    sample = f"sample {seq} of {row.machine}, spool {row.spool_id:016x}"
                    problem = "is another in a further archive; find out which is right, and leave the other out"
                    raise StoreError(origin, f"{sample}, {problem}")
                new[seq - row.first_seq] = False
        return new

    def _write(self, row: JournalRow, first: int, end: int) -> None:
        """Write the samples first <= i < end of a row."""
        batch = SampleBatch(row.machine, row.spool_id, row.first_seq + first, row.rows[first:end], self._frame)
        number = self._journal.append(Admission(batch, trimmed=0, lost=0), row.received_ns)
        spool = (row.machine, row.spool_id)
        insort(self._there.setdefault(spool, []), (batch.first_seq, batch.last_seq, number))
        self.kept[spool] += end - first
