"""The pages of one block by time: the newest buckets apart, older ones summed into hours, days and all before.

What is kept apart goes by rank, cell by cell, not by age: ground that is driven once a day keeps its last passes apart
as well as the haul road beside it, and a cell never takes more than a fixed number of places. The newest buckets of
a set do not depend on the order in which they came, and summing commutes, so that a timeline is a function of the
samples alone. That is why it may be settled late, and why the timelines of two sets of samples merge into that of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.pages import CELL, EMPTY, RAW_CELL, CompactPages, PackedPages, Page, pick
from mapserver.evidence.timeline_kernel import settle
from protocol.arrays import AnyArray, Bools, Ints

HOUR_S, DAY_S = 3600, 86_400
PATIENCE = 24  # pages that wait before a timeline is settled: fewer cost time, more cost memory
Block = tuple[int, int]  # column and row


@dataclass(frozen=True, slots=True)
class TimedPage:
    """A page, and the span of time that its samples lie in."""

    first_ns: int
    end_ns: int
    page: Page


class TimedPages(Sequence[TimedPage]):
    """Pages of one block in the order of time, as they were at one moment; expanded anew whenever they are read.

    A page of a coarser tier may begin before one of a finer tier ends: both have evidence of the same hour. In each
    cell, the finer one is newer. derived: what readers found out about these pages, by what it depends on; as long as
    nothing was folded into a block, its pages are this same object.
    """

    __slots__ = ("_pages", "_tiers", "derived")

    def __init__(self, pages: CompactPages, tiers: Tiers) -> None:
        self._pages, self._tiers = pages, tiers
        self.derived: dict[object, Any] = {}

    def __len__(self) -> int:
        return len(self._pages.table)

    def __iter__(self) -> Iterator[TimedPage]:
        spans = self._tiers.spans_ns.tolist()
        pages = sorted(self._pages.expanded().items(), key=lambda item: (-item[0], item[1]))
        return (TimedPage(*_time_of(spans[tier], index, page), page) for tier, index, page in pages)

    def packed_votes(self) -> tuple[NDArray[np.uint64], Ints]:
        """As the function of this name, without a page by itself."""
        pages = self._pages.expanded()
        order = np.lexsort((pages.table[:, 1], -pages.table[:, 0]))
        parts = [pages.votes[first:end] for first, end in pages.table[order, 2:4].tolist()]
        lengths = pages.table[order, 3] - pages.table[order, 2]
        return np.concatenate([np.empty(0, np.uint64), *parts]), np.cumsum(lengths)

    @overload
    def __getitem__(self, index: int) -> TimedPage: ...
    @overload
    def __getitem__(self, index: slice) -> list[TimedPage]: ...
    def __getitem__(self, index: int | slice) -> TimedPage | list[TimedPage]:
        return list(self)[index]


@dataclass(frozen=True)
class Tiers:
    """Spans of growing lengths [ns], of which the newest `keeps` of each cell stay apart; the last one has no end."""

    spans_ns: Ints
    keeps: Ints

    @classmethod
    def from_config(cls, config: FoldConfig) -> Tiers:
        """Buckets, hours, days, and everything before them."""
        spans = (config.bucket_ns, HOUR_S * 10**9, DAY_S * 10**9, 0)
        return cls(np.array(spans), np.array((config.keep_buckets, config.keep_hours, config.keep_days, 0)))


def packed_votes(pages: Sequence[TimedPage]) -> tuple[NDArray[np.uint64], Ints]:
    """Votes of pages as PackedPages has them, in the order of time, and where those of each page end."""
    if isinstance(pages, TimedPages):
        return pages.packed_votes()
    columns = ((timed.page.votes["place"], timed.page.votes["count"].astype(np.uint64)) for timed in pages)
    parts = [count << np.uint64(16) | place for place, count in columns]
    return np.concatenate([np.empty(0, np.uint64), *parts]), np.cumsum([len(part) for part in parts], dtype=np.int64)


class Space:
    """Where timelines are settled, one at a time: the pages that there are, those that come of them, and their sums."""

    def __init__(self) -> None:
        self.counts = np.zeros(ev.COUNTS * ev.CELLS, np.uint64)
        self.votes, self.out_votes = np.empty(0, np.uint64), np.empty(0, np.uint64)
        self.cells: AnyArray = np.empty(0, RAW_CELL)
        self.out_cells: AnyArray = np.empty(0, RAW_CELL)

    def grow(self, votes: int, cells: int) -> None:
        """Have space for so many votes and cells, and one more of each for the kernel, which writes one place ahead."""
        if votes >= len(self.votes):
            self.votes, self.out_votes = (np.empty(2 * votes + 1, np.uint64) for _ in range(2))
        if cells >= len(self.cells):
            self.cells, self.out_cells = (np.empty(2 * cells + 1, RAW_CELL) for _ in range(2))


class Timeline:
    """Pages of one block: settled ones, and those that came since.

    known_cells: how many cells have evidence. space: where it is settled, that of the thread which adds or reads.
    """

    __slots__ = ("_fresh", "_known", "_settled", "_tiers", "_timed", "_waiting", "known_cells", "space")

    def __init__(self, tiers: Tiers, space: Space, settled: CompactPages = EMPTY) -> None:
        self._tiers, self.space = tiers, space
        self._settled = settled
        self._fresh: list[PackedPages] = []
        self._waiting = 0
        self._timed: TimedPages | None = None
        self._known: Bools = np.zeros(ev.CELLS, np.bool_)
        self._known[settled.marks[:, 0]] = True
        self.known_cells = int(np.count_nonzero(self._known))

    def add(self, pages: PackedPages) -> int:
        """Add evidence of any tiers and spans, also of those that are there; returns how many cells are new."""
        known_before = self.known_cells
        self._fresh.append(pages)
        self._known[pages.cells["cell"]] = True
        self.known_cells = int(np.count_nonzero(self._known))
        self._waiting += len(pages.table)
        if self._waiting >= PATIENCE:
            self.settled()
        return self.known_cells - known_before

    def settled(self) -> CompactPages:
        """All pages, in the order of tier and index, each cell's newest spans apart."""
        if self._fresh:
            self._settled = _settled(self._settled, self._fresh, self._tiers, self.space)
            self._fresh, self._waiting, self._timed = [], 0, None
        return self._settled

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Tier, index on it, and page, sorted."""
        return self.settled().expanded().items()

    def timed(self) -> TimedPages:
        """Pages in the order of time; the same object until something is added."""
        self.settled()
        if self._timed is None:
            self._timed = TimedPages(self._settled, self._tiers)
        return self._timed


def _time_of(span_ns: int, index: int, page: Page) -> tuple[int, int]:
    """First and end time of a page; before all spans, it ends with its newest sample."""
    return index * span_ns, (index + 1) * span_ns if span_ns else int(page.cells["newest_ns"].max()) + 1


def _settled(settled: CompactPages, fresh: list[PackedPages], tiers: Tiers, space: Space) -> CompactPages:
    votes, cells = len(settled.cells), len(settled.marks)
    if not cells and len(fresh) == 1 and len(fresh[0].table) <= tiers.keeps[0] and not fresh[0].table[:, 0].any():
        (only,) = fresh  # few buckets, in order and each once, as the fold or another timeline gives them: all are kept
        return CompactPages.from_packed(only.table.copy(), only.votes.astype(np.uint64), only.cells)
    table = np.concatenate([settled.table.astype(np.int64), *(pages.table for pages in fresh)])
    space.grow(votes + sum(len(pages.votes) for pages in fresh), cells + sum(len(pages.cells) for pages in fresh))
    row = len(settled.table)
    if cells:
        settled.expand_into(PackedPages(table[:row], space.votes[:votes], space.cells[:cells].view(CELL)))
    for pages in fresh:
        table[row : row + len(pages.table), 2:4] += votes
        table[row : row + len(pages.table), 4:6] += cells
        space.votes[votes : votes + len(pages.votes)] = pages.votes
        space.cells[cells : cells + len(pages.cells)] = pages.cells.view(RAW_CELL)
        row, votes, cells = row + len(pages.table), votes + len(pages.votes), cells + len(pages.cells)
    out_table: Ints = np.empty((len(table) * len(tiers.keeps), 6), np.int64)
    out_cells = space.out_cells.view(CELL)
    before = space.votes, space.cells.view(CELL)
    n, used, filled = settle(
        table, *before, tiers.spans_ns, tiers.keeps, space.counts, out_table, space.out_votes, out_cells
    )
    return CompactPages.from_packed(out_table[:n], space.out_votes[:used], out_cells[:filled])


def evidence(pages: Sequence[Sequence[TimedPage]], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks, in the order of time.

    first: for each block, index (256,) of the first page that counts in each of its cells; without it all pages count.
    """
    counts = np.zeros((len(pages), ev.COUNTS, ev.CELLS), np.uint64)
    bitmaps = np.zeros((len(pages), ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    changed_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    for i, block_pages in enumerate(pages):
        start = first[i] if first else np.zeros(ev.CELLS, np.int64)
        _sum(block_pages, start, counts[i].reshape(-1), bitmaps[i], newest_ns[i])
        if start.any():
            changed_ns[i] = _changed_ns(block_pages, start)
    return ev.Evidence(counts.transpose(0, 2, 1), bitmaps, newest_ns, changed_ns)


def _sum(
    pages: Sequence[TimedPage], start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints
) -> None:
    last = int(start.max(initial=0))
    for index, timed in enumerate(pages):
        page = timed.page if index >= last else pick(timed.page, start <= index)
        page.add_to(counts, bitmaps, newest_ns)


def _changed_ns(pages: Sequence[TimedPage], start: Ints) -> Ints:
    """When each cell (256,) changed, 0 where it did not: after its last old sample, and within the first new span."""
    changed_ns = np.zeros(ev.CELLS, np.int64)
    for index, timed in enumerate(pages):
        begins = start == index
        changed_ns[begins & (start > 0)] = np.maximum(changed_ns, timed.first_ns)[begins & (start > 0)]
        cells = timed.page.cells
        old = start[cells["cell"]] > index
        at = cells["cell"][old]
        changed_ns[at] = np.maximum(changed_ns[at], cells["newest_ns"][old])
    return changed_ns
