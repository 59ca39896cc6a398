"""The pages of one block by time: newest buckets apart, older ones summed into hours, days and all before.

Each cell keeps by rank, not age: ground driven once a day keeps its last passes apart like a haul road, and memory is
bounded. The newest buckets of a set do not depend on its order, and sums commute, so a timeline is a function of the
samples. Hence it can be settled late and merged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
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

PATIENCE = 24  # waiting pages before a timeline is settled: fewer cost time, more memory
Block = tuple[int, int]  # column and row
Ages = Mapping[Block, Ints]  # start [ns] of the present ground of cells (256,), 0 for ever; only blocks with any


@dataclass(frozen=True, slots=True)
class TimedPage:
    """A page with the time span of its samples."""

    first_ns: int
    end_ns: int
    page: Page


class TimedPages:
    """Pages of one block by time, at one moment; expanded on each read.

    Pages of coarser and finer tiers may overlap; in each cell the finer is newer. derived: readers' cache, by what it
    depends on. Until a block is folded again, its pages are the same object.
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
        """Votes as in Pages, and the end of each page's."""
        votes, ends = np.empty(vote_count(self.record), np.uint64), np.zeros(len(self), np.int64)
        votes_in_time(as_numbers(self.record), votes, ends)
        return votes, ends

    def older(self, count: int) -> TimedPages:
        """The first pages."""
        pages = Pages.unpacked(self.record)
        kept = ranks(pages.table) < count
        lengths = pages.table[:, [3, 5]] - pages.table[:, [2, 4]]
        votes, cells = (part[np.repeat(kept, n)] for part, n in zip(pages[1:], lengths.T, strict=True))
        table, ends = pages.table[kept], lengths[kept].cumsum(axis=0)
        table[:, [3, 5]], table[:, [2, 4]] = ends, ends - lengths[kept]
        return TimedPages(Pages(table, votes, cells).record, self._tiers)


NO_PAGES = TimedPages(EMPTY, Tiers.from_config(FoldConfig()))


class Timeline:
    """Evidence of one block: its settled record, later ones, and the number of waiting pages.

    known: a bit for each cell with evidence. turn: of the last addition. timed: its pages, once read.
    """

    __slots__ = ("known", "records", "timed", "turn", "waiting")

    def __init__(self, settled: Sequence[Record] = ()) -> None:
        self.records = [*settled]
        self.known = known_cells(settled[0]) if settled else 0
        self.waiting = self.turn = 0
        self.timed: TimedPages | None = None

    def add(self, record: Record) -> int:
        """Add evidence of any tiers and spans; returns the number of new cells. It waits for `settle_all`."""
        self.records.append(record)
        self.waiting += page_count(record)
        before = self.known
        self.known |= known_cells(record)
        return (self.known ^ before).bit_count()


def settle_all(timelines: Iterable[Timeline], tiers: Tiers, space: Space, least: int = 1) -> None:
    """Settle timelines with at least so many waiting pages, together for speed."""
    some = [timeline for timeline in timelines if timeline.waiting >= least]
    keep = int(tiers.keeps[0])  # a single record with no more pages keeps all apart
    sums = [timeline for timeline in some if len(timeline.records) > 1 or page_count(timeline.records[0]) > keep]
    for timeline, record in zip(sums, settled([timeline.records for timeline in sums], tiers, space), strict=True):
        timeline.records = [record]
    for timeline in some:
        timeline.waiting, timeline.timed = 0, None


def timed(timelines: Iterable[Timeline | None], tiers: Tiers, space: Space) -> list[TimedPages]:
    """Pages of blocks by time, empty without evidence; the same object until something is added."""
    lines = list(timelines)
    settle_all(filter(None, lines), tiers, space)
    for line in lines:
        if line and line.timed is None:
            line.timed = TimedPages(line.records[0], tiers)
    return [NO_PAGES if line is None or line.timed is None else line.timed for line in lines]


def _time_of(span_ns: int, index: int, page: Page) -> tuple[int, int]:
    """The last tier ends with its newest sample."""
    return index * span_ns, (index + 1) * span_ns if span_ns else int(page.cells["newest_ns"].max()) + 1


def evidence(pages: Sequence[TimedPages], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks by time.

    first: by block, index (256,) of the first page that counts in each cell; None for all pages.
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


def plane_counts(pages: Sequence[TimedPages], planes: slice) -> Ints:
    """Counts (blocks, planes, 256) of some planes, over all pages; a shortcut."""
    out = np.zeros((len(pages), planes.stop - planes.start, ev.CELLS), np.int64)
    for data, counts in zip([as_numbers(each.record) for each in pages], out, strict=True):
        sum_planes(data, planes.start, counts)
    return out


def _changed_ns(pages: TimedPages, start: Ints) -> Ints:
    """Change of each cell (256,), 0 for none: after its last old sample, in the first new span."""
    changed_ns = np.zeros(ev.CELLS, np.int64)
    for index, timed in enumerate(pages):
        begins = start == index
        changed_ns[begins & (start > 0)] = np.maximum(changed_ns, timed.first_ns)[begins & (start > 0)]
        cells = timed.page.cells
        old = start[cells["cell"]] > index
        at = cells["cell"][old]
        changed_ns[at] = np.maximum(changed_ns[at], cells["newest_ns"][old])
    return changed_ns
