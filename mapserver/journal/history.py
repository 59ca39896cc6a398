"""The past: archive and journal as one, maps of any time folded from them, and copies of them.

The samples are the truth, every map is a fold over them; so a map of the past needs no more than their stamps.
"""

from __future__ import annotations

import math
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from heapq import heapify, heappop, heappush
from typing import Any

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.grid import Grid
from mapserver.evidence.votes import STD_FLOOR_M, FoldConfig
from mapserver.ingest.admission import Admission
from mapserver.journal.archive import FOLDER, Archive
from mapserver.journal.journal import LAST, ArchivedError, Journal, JournalReads
from mapserver.journal.rows import ALL, JournalRow, Mark, Wanted
from protocol.arrays import Bools, Table
from protocol.errors import StoreError
from protocol.site.geometry import BLOCK_CELLS, Bounds, CellWindow, GridGeometry
from protocol.wire.messages import SampleBatch

Spool = tuple[str, int]  # machine, spool_id


@dataclass(frozen=True)
class History:
    """All rows of one store. Used by one thread at a time, as its journal's connection is."""

    journal: JournalReads
    archive: Archive

    @classmethod
    def of(cls, journal: JournalReads) -> History:
        """A journal and the archive beside it."""
        return cls(journal, Archive(journal.path.parent / FOLDER))


@dataclass(frozen=True)
class Moment:
    """Evidence of one cell from samples with first_ns <= stamp <= last_ns; arrays as in Evidence, (1, 1, ...)."""

    first_ns: int
    last_ns: int
    evidence: ev.Evidence


def history_rows(history: History, after: int = 0, until: int = LAST, wanted: Wanted = ALL) -> Iterator[JournalRow]:
    """Rows after < row <= until in order, from archive and journal, each once, also while rows move between them."""
    while True:
        try:
            for row in history.journal.read(after, until, wanted):
                yield row
                after = row.row
        except ArchivedError as error:
            archived = min(error.archived_row, until)
        else:
            return
        yield from history.archive.read(after, archived, wanted)
        after = archived


def samples_of(row: JournalRow, wanted: Wanted) -> Table:
    """Samples of a row that are wanted by stamp and place, in their order."""
    stamps, x_m, y_m = (row.rows[name] for name in ("stamp_ns", "x_m", "y_m"))
    found = (stamps >= wanted.from_ns) & (stamps <= wanted.to_ns)
    if place := wanted.bounds:
        found &= (x_m >= place.west_m) & (x_m <= place.east_m) & (y_m >= place.south_m) & (y_m <= place.north_m)
    return row.rows[found]


def grid_as_of(
    history: History,
    to_ns: int,
    cell_m: float,
    config: FoldConfig,
    window: CellWindow | None = None,
    without: frozenset[str] = frozenset(),
) -> Grid:
    """Fold all samples stamped `to_ns` or earlier, without the machines in `without`.

    window: only the evidence of these cells is complete, and nothing far from them is read.
    """
    bounds = _reaching(window, cell_m, config) if window else None
    wanted = Wanted(to_ns=to_ns, bounds=bounds, without=without)
    grid = Grid(cell_m, config)
    for row in history_rows(history, wanted=wanted):
        grid.fold(samples_of(row, wanted), row.machine)
    return grid


def point_history(
    history: History,
    cell: tuple[int, int],
    cell_m: float,
    config: FoldConfig,
    wanted: Wanted = ALL,
    span_s: float | None = None,
) -> list[Moment]:
    """Evidence of one cell (column, row) over time, oldest first; spans without any are left out.

    wanted: time and machines; its bounds are not used. span_s: length of a span, a bucket where it is not given.
    """
    window = CellWindow(*cell, 1, 1)
    wanted = replace(wanted, bounds=_reaching(window, cell_m, config))
    span_ns = round((span_s or config.bucket_s) * 1e9)
    parts: dict[int, dict[str, list[Table]]] = {}
    for row in history_rows(history, wanted=wanted):
        samples = samples_of(row, wanted)
        spans = samples["stamp_ns"] // span_ns
        for span in np.unique(spans).tolist():
            parts.setdefault(span, {}).setdefault(row.machine, []).append(samples[spans == span])
    found = []
    for span in sorted(parts):
        evidence = _cell_evidence(parts[span], cell, cell_m, config)
        if evidence.weight.any():
            found.append(Moment(span * span_ns, (span + 1) * span_ns - 1, evidence))
    return found


def _cell_evidence(
    parts: dict[str, list[Table]], cell: tuple[int, int], cell_m: float, config: FoldConfig
) -> ev.Evidence:
    grid = Grid(cell_m, config)
    for machine, samples in parts.items():
        grid.fold(np.concatenate(samples), machine)
    column, row = cell
    block = grid.evidence([(column // BLOCK_CELLS, row // BLOCK_CELLS)])
    place = row % BLOCK_CELLS * BLOCK_CELLS + column % BLOCK_CELLS
    return ev.Evidence(**{f.name: getattr(block, f.name)[:, place : place + 1] for f in fields(block)})


def _reaching(window: CellWindow, cell_m: float, config: FoldConfig) -> Bounds:
    """Where samples that vote in a window can lie: 3 sigma of the least sure that may vote, and a cell for rounding."""
    reach_m = 3 * math.hypot(config.std_cap_m, STD_FLOOR_M) + cell_m
    inner = GridGeometry(cell_m).bounds(window)
    return Bounds(inner.west_m - reach_m, inner.south_m - reach_m, inner.east_m + reach_m, inner.north_m + reach_m)


def merged(sources: Sequence[tuple[str, int, Iterator[JournalRow]]]) -> Iterator[tuple[str, JournalRow]]:
    """Rows of several sources, each in row order, in the order of reception; with the name of their source.

    sources: names, when the first row was received, and the rows; these are not touched before their time comes, so
    that thousands of files may follow each other.
    """
    waiting = [((first_ns,), i, name, None, rows) for i, (name, first_ns, rows) in enumerate(sources)]
    heap: list[tuple[tuple[Any, ...], int, str, JournalRow | None, Iterator[JournalRow]]] = [*waiting]
    heapify(heap)
    while heap:
        _, i, name, row, rows = heappop(heap)
        if row:
            yield name, row
        if row := next(rows, None):
            key = (row.received_ns, row.machine, row.spool_id, row.first_seq, len(row.rows))
            heappush(heap, (key, i, name, row, rows))


class Copier:
    """Copies samples to a new journal, each once, with the identity that they have.

    kept: samples by spool. left_out: how many, by reason: their machine, their time, or that they came twice.
    """

    def __init__(self, journal: Journal, frame: str, wanted: Wanted) -> None:
        self.kept: Counter[Spool] = Counter()
        self.left_out: Counter[str] = Counter(machine=0, time=0, twice=0)
        self._journal = journal
        self._frame = frame
        self._wanted = wanted
        self._reached: Counter[Spool] = Counter()
        self._there: dict[Spool, list[tuple[int, int, int]]] = {}  # first seq, last seq, row; in order

    def add(self, origin: str, row: JournalRow) -> None:
        """Write what is wanted of a row into the open transaction; StoreError where it is there, but is another.

        origin: where the row is from, for the error.
        """
        spool = (row.machine, row.spool_id)
        self._reached[spool] = max(self._reached[spool], row.first_seq + len(row.rows) - 1)
        if row.machine in self._wanted.without:
            self.left_out["machine"] += len(row.rows)
            return
        stamps = row.rows["stamp_ns"]
        in_time = (stamps >= self._wanted.from_ns) & (stamps <= self._wanted.to_ns)
        new = self._are_new(origin, row)
        self.left_out["time"] += int((~in_time).sum())
        self.left_out["twice"] += int((in_time & ~new).sum())
        edges = np.flatnonzero(np.diff(in_time & new, prepend=False, append=False)).tolist()
        for first, end in zip(edges[::2], edges[1::2], strict=True):
            self._write(row, first, end)

    def finish(self, reached: Mapping[Spool, int]) -> None:
        """Write the watermarks into the open transaction: machines go on where they are, what is left out is lost.

        reached: further watermarks, of spools whose rows may not have been read.
        """
        for spool, seq in reached.items():
            self._reached[spool] = max(self._reached[spool], seq)
        for spool, seq in self._reached.items():
            newest_ns = self._journal.mark(*spool).newest_ns
            self._journal.put_mark(*spool, Mark(seq, seq - self.kept[spool], newest_ns))

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
                    problem = (
                        f"sample {seq} of {row.machine}, spool {row.spool_id:016x}, is another in a further archive"
                    )
                    raise StoreError(origin, f"{problem}; find out which is right, and leave the other out")
                new[seq - row.first_seq] = False
        return new

    def _write(self, row: JournalRow, first: int, end: int) -> None:
        """Write the samples first <= i < end of a row."""
        batch = SampleBatch(row.machine, row.spool_id, row.first_seq + first, row.rows[first:end], self._frame)
        number = self._journal.append(Admission(batch, trimmed=0, lost=0), row.received_ns)
        spool = (row.machine, row.spool_id)
        insort(self._there.setdefault(spool, []), (batch.first_seq, batch.last_seq, number))
        self.kept[spool] += end - first
