"""The pages of one block by time: the newest buckets apart, older ones summed into hours, days and all before.

What is kept apart goes by rank, cell by cell, not by age: ground that is driven once a day keeps its last passes apart
as well as the haul road beside it, and a cell never takes more than a fixed number of places. The newest buckets of
a set do not depend on the order in which they came, and summing commutes, so that a timeline is a function of the
samples alone. That is why it may be settled late, and why the timelines of two sets of samples merge into that of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.pages import EMPTY, Page, Pages, Record, as_numbers, known_cells, page_count, vote_count
from mapserver.evidence.record_kernels import ranks, sum_planes, sum_records, votes_in_time
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


class TimedPages:
    """Pages of one block in the order of time, as they were at one moment; expanded anew whenever they are read.

    A page of a coarser tier may begin before one of a finer tier ends: both have evidence of the same hour. In each
    cell, the finer one is newer. derived: what readers found out about these pages, by what it depends on; as long as
    nothing was folded into a block, its pages are this same object.
    """

    __slots__ = ("_tiers", "derived", "record")

    def __init__(self, record: Record, tiers: Tiers) -> None:
        self.record, self._tiers = record, tiers
        self.derived: dict[object, Any] = {}

    def __len__(self) -> int:
        return page_count(self.record)

    def __iter__(self) -> Iterator[TimedPage]:
        spans = self._tiers.spans_ns.tolist()
        pages = sorted(Pages.unpacked(self.record).items(), key=lambda item: (-item[0], item[1]))
        return (TimedPage(*_time_of(spans[tier], index, page), page) for tier, index, page in pages)

    def packed_votes(self) -> tuple[NDArray[np.uint64], Ints]:
        """Votes as Pages has them, and where those of each page end."""
        votes, ends = np.empty(vote_count(self.record), np.uint64), np.zeros(len(self), np.int64)
        votes_in_time(as_numbers(self.record), votes, ends)
        return votes, ends

    def plane_counts(self, planes: slice) -> Ints:
        """Counts (planes, 256) of some planes, of all pages together: quicker than all that there is of them."""
        out = np.zeros((planes.stop - planes.start, ev.CELLS), np.int64)
        sum_planes(as_numbers(self.record), planes.start, out)
        return out

    def older(self, count: int) -> TimedPages:
        """The first pages alone."""
        pages = Pages.unpacked(self.record)
        kept = ranks(pages.table) < count
        lengths = pages.table[:, [3, 5]] - pages.table[:, [2, 4]]
        votes, cells = (part[np.repeat(kept, n)] for part, n in zip(pages[1:], lengths.T, strict=True))
        table, ends = pages.table[kept], lengths[kept].cumsum(axis=0)
        table[:, [3, 5]], table[:, [2, 4]] = ends, ends - lengths[kept]
        return TimedPages(Pages(table, votes, cells).record, self._tiers)


NO_PAGES = TimedPages(EMPTY, Tiers.from_config(FoldConfig()))


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


def timed(timelines: Iterable[Timeline | None], tiers: Tiers, space: Space) -> list[TimedPages]:
    """Pages of blocks in the order of time, none of one without evidence; the same object until something is added."""
    lines = list(timelines)
    settle_all(filter(None, lines), tiers, space)
    for line in lines:
        if line and line.timed is None:
            line.timed = TimedPages(line.records[0], tiers)
    return [line.timed if line and line.timed else NO_PAGES for line in lines]


def _time_of(span_ns: int, index: int, page: Page) -> tuple[int, int]:
    """First and end time of a page; before all spans, it ends with its newest sample."""
    return index * span_ns, (index + 1) * span_ns if span_ns else int(page.cells["newest_ns"].max()) + 1


def evidence(pages: Sequence[TimedPages], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks, in the order of time.

    first: for each block, index (256,) of the first page that counts in each of its cells; without it all pages count.
    """
    records = [each.record for each in pages]
    counts = np.zeros((len(pages), ev.CELLS, ev.COUNTS), np.uint64)
    bitmaps = np.zeros((len(pages), ev.CELLS, 2), np.uint64)
    newest_ns, start, changed_ns = np.zeros((3, len(pages), ev.CELLS), np.int64)
    if first:
        start[:] = first
    begins = np.cumsum([0, *map(len, records)])[:-1]
    sum_records(as_numbers(b"".join(records)), begins, start, counts, bitmaps, newest_ns)
    for i in np.flatnonzero(start.any(axis=1)).tolist():
        changed_ns[i] = _changed_ns(pages[i], start[i])
    return ev.Evidence(counts, bitmaps, newest_ns, changed_ns)


def _changed_ns(pages: TimedPages, start: Ints) -> Ints:
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
