"""The pages of one block by time: the newest buckets apart, older ones summed into hours, days and all before.

What is kept apart goes by rank, cell by cell, not by age: ground that is driven once a day keeps its last passes apart
as well as the haul road beside it, and a cell never takes more than a fixed number of places. The newest buckets of
a set do not depend on the order in which they came, and summing commutes, so that a timeline is a function of the
samples alone. That is why it may be settled late, and why the timelines of two sets of samples merge into that of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import Page, Pages, Record, as_numbers, known_cells, page_count, pick
from mapserver.evidence.record_kernels import sum_pages, sum_planes
from mapserver.evidence.settling import Space, Tiers, settled
from protocol.arrays import Ints

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

    __slots__ = ("_record", "_tiers", "derived")

    def __init__(self, record: Record, tiers: Tiers) -> None:
        self._record, self._tiers = record, tiers
        self.derived: dict[object, Any] = {}

    def __len__(self) -> int:
        return page_count(self._record)

    def __iter__(self) -> Iterator[TimedPage]:
        spans = self._tiers.spans_ns.tolist()
        pages = sorted(Pages.unpacked(self._record).items(), key=lambda item: (-item[0], item[1]))
        return (TimedPage(*_time_of(spans[tier], index, page), page) for tier, index, page in pages)

    def packed_votes(self) -> tuple[NDArray[np.uint64], Ints]:
        """As the function of this name, without a page by itself."""
        pages = Pages.unpacked(self._record)
        table = _in_order(pages.table)
        parts = [pages.votes[first:end] for first, end in table[:, 2:4].tolist()]
        return np.concatenate([np.empty(0, np.uint64), *parts]), np.cumsum(table[:, 3] - table[:, 2])

    def plane_counts(self, planes: slice) -> Ints:
        """As the function of this name."""
        out = np.zeros((planes.stop - planes.start, ev.CELLS), np.int64)
        sum_planes(as_numbers(self._record), planes.start, out)
        return out

    def add_to(self, start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> None:
        """Add what counts from page `start` (256,) of each cell on, as `sum_pages` does."""
        pages = Pages.unpacked(self._record)
        sum_pages(_in_order(pages.table), pages.votes, pages.cells, start, counts, bitmaps, newest_ns)

    @overload
    def __getitem__(self, index: int) -> TimedPage: ...
    @overload
    def __getitem__(self, index: slice) -> list[TimedPage]: ...
    def __getitem__(self, index: int | slice) -> TimedPage | list[TimedPage]:
        return list(self)[index]


def _in_order(table: Ints) -> Ints:
    """The table of Pages in the order of time."""
    return np.asarray(table[np.lexsort((table[:, 1], -table[:, 0]))])


def packed_votes(pages: Sequence[TimedPage]) -> tuple[NDArray[np.uint64], Ints]:
    """Votes of pages as Pages has them, in the order of time, and where those of each page end."""
    if isinstance(pages, TimedPages):
        return pages.packed_votes()
    columns = ((timed.page.votes["place"], timed.page.votes["count"].astype(np.uint64)) for timed in pages)
    parts = [count << np.uint64(16) | place for place, count in columns]
    return np.concatenate([np.empty(0, np.uint64), *parts]), np.cumsum([len(part) for part in parts], dtype=np.int64)


def plane_counts(pages: Sequence[TimedPage], planes: slice) -> Ints:
    """Counts (planes, 256) of some planes, of all pages together: quicker than all that there is of them."""
    if isinstance(pages, TimedPages):
        return pages.plane_counts(planes)
    packed, _ = packed_votes(pages)
    counts = np.zeros(ev.COUNTS * ev.CELLS, np.int64)
    np.add.at(counts, (packed & np.uint64(0xFFFF)).astype(np.int64), (packed >> np.uint64(16)).astype(np.int64))
    return counts.reshape(ev.COUNTS, ev.CELLS)[planes]


class Timeline:
    """Evidence of one block: a record that is settled, those that came since, and how many pages of them wait.

    known: a bit for each cell with evidence. turn: of the grid, when it was added to last. timed: its pages, once read.
    """

    __slots__ = ("known", "records", "timed", "turn", "waiting")

    def __init__(self, settled: Sequence[Record] = ()) -> None:
        self.records = [*settled]
        self.known = known_cells(settled[0]) if settled else 0
        self.waiting = self.turn = 0
        self.timed: TimedPages | None = None

    def add(self, record: Record) -> int:
        """Add evidence of any tiers and spans, also of those that are there; returns how many cells are new.

        It waits to be settled; see `settle_all`.
        """
        self.records.append(record)
        self.waiting += page_count(record)
        before = self.known
        self.known |= known_cells(record)
        return (self.known ^ before).bit_count()


def settle_all(timelines: Iterable[Timeline], tiers: Tiers, space: Space, least: int = 1) -> None:
    """Settle those timelines on which at least so many pages wait: quicker than one by one."""
    some = [timeline for timeline in timelines if timeline.waiting >= least]
    keep = int(tiers.keeps[0])  # buckets: so few pages of one record, each of another span, are all kept apart
    sums = [timeline for timeline in some if len(timeline.records) > 1 or page_count(timeline.records[0]) > keep]
    for timeline, record in zip(sums, settled([timeline.records for timeline in sums], tiers, space), strict=True):
        timeline.records = [record]
    for timeline in some:
        timeline.waiting, timeline.timed = 0, None


def timed(timelines: Iterable[Timeline | None], tiers: Tiers, space: Space) -> list[Sequence[TimedPage]]:
    """Pages of blocks in the order of time, none of one without evidence; the same object until something is added."""
    lines = list(timelines)
    settle_all(filter(None, lines), tiers, space)
    for line in lines:
        if line and line.timed is None:
            line.timed = TimedPages(line.records[0], tiers)
    return [line.timed if line and line.timed else () for line in lines]


def _time_of(span_ns: int, index: int, page: Page) -> tuple[int, int]:
    """First and end time of a page; before all spans, it ends with its newest sample."""
    return index * span_ns, (index + 1) * span_ns if span_ns else int(page.cells["newest_ns"].max()) + 1


def evidence(pages: Sequence[Sequence[TimedPage]], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks, in the order of time.

    first: for each block, index (256,) of the first page that counts in each of its cells; without it all pages count.
    """
    counts = np.zeros((len(pages), ev.CELLS, ev.COUNTS), np.uint64)
    bitmaps = np.zeros((len(pages), ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    changed_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    for i, block_pages in enumerate(pages):
        start = first[i] if first else np.zeros(ev.CELLS, np.int64)
        if isinstance(block_pages, TimedPages):
            block_pages.add_to(start, counts[i], bitmaps[i], newest_ns[i])
        else:
            _sum(block_pages, start, counts[i], bitmaps[i], newest_ns[i])
        if start.any():
            changed_ns[i] = _changed_ns(block_pages, start)
    return ev.Evidence(counts, bitmaps, newest_ns, changed_ns)


def _sum(
    pages: Sequence[TimedPage], start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints
) -> None:
    last = int(start.max(initial=0))
    planes = np.zeros(ev.COUNTS * ev.CELLS, np.uint64)
    for index, timed in enumerate(pages):
        page = timed.page if index >= last else pick(timed.page, start <= index)
        page.add_to(planes, bitmaps, newest_ns)
    counts += planes.reshape(ev.COUNTS, ev.CELLS).T


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
