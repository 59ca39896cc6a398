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
from mapserver.evidence.page_kernels import note, sum_pages, sum_planes
from mapserver.evidence.pages import EMPTY, CompactPages, PackedPages, Page, pick
from mapserver.evidence.settling import Space, Tiers, settled
from protocol.arrays import Bools, Ints

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
        table, votes = self._pages.expanded_votes()
        table = _in_order(table)
        parts = [votes[first:end] for first, end in table[:, 2:4].tolist()]
        return np.concatenate([np.empty(0, np.uint64), *parts]), np.cumsum(table[:, 3] - table[:, 2])

    def plane_counts(self, planes: slice) -> Ints:
        """As the function of this name."""
        pages, out = self._pages, np.zeros((planes.stop - planes.start, ev.CELLS), np.int64)
        sum_planes(pages.runs, pages.cells, pages.counts, pages.high, planes.start, out)
        return out

    def add_to(self, start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints) -> None:
        """Add what counts from page `start` (256,) of each cell on, as `sum_pages` does."""
        pages = self._pages.expanded()
        sum_pages(_in_order(pages.table), pages.votes, pages.cells, start, counts, bitmaps, newest_ns)

    @overload
    def __getitem__(self, index: int) -> TimedPage: ...
    @overload
    def __getitem__(self, index: slice) -> list[TimedPage]: ...
    def __getitem__(self, index: int | slice) -> TimedPage | list[TimedPage]:
        return list(self)[index]


def _in_order(table: Ints) -> Ints:
    """The table of PackedPages in the order of time."""
    return np.asarray(table[np.lexsort((table[:, 1], -table[:, 0]))])


def packed_votes(pages: Sequence[TimedPage]) -> tuple[NDArray[np.uint64], Ints]:
    """Votes of pages as PackedPages has them, in the order of time, and where those of each page end."""
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
    """Pages of one block: kept are those that are settled, fresh those that came since, waiting is how many.

    known_cells: how many cells have evidence. space: where it is settled, that of the thread which adds or reads.
    """

    __slots__ = ("_known", "_timed", "fresh", "kept", "known_cells", "space", "tiers", "waiting")

    def __init__(self, tiers: Tiers, space: Space, settled: CompactPages = EMPTY) -> None:
        self.tiers, self.space = tiers, space
        self.kept = settled
        self.fresh: list[PackedPages] = []
        self.waiting = 0
        self._timed: TimedPages | None = None
        self._known: Bools = np.zeros(ev.CELLS, np.bool_)
        self._known[settled.marks[:, 0]] = True
        self.known_cells = int(np.count_nonzero(self._known))

    def add(self, pages: PackedPages) -> int:
        """Add evidence of any tiers and spans, also of those that are there; returns how many cells are new.

        It waits to be settled; see `settle_all`.
        """
        self.fresh.append(pages)
        self.waiting += len(pages.table)
        more = note(self._known, pages.cells)
        self.known_cells += more
        return more

    def keep(self, pages: CompactPages) -> None:
        """Go on with these pages, which hold the fresh ones as well."""
        self.kept, self.fresh, self.waiting, self._timed = pages, [], 0, None

    def settled(self) -> CompactPages:
        """All pages, in the order of tier and index, each cell's newest spans apart."""
        settle_all([self])
        return self.kept

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Tier, index on it, and page, sorted."""
        return self.settled().expanded().items()

    def timed(self) -> TimedPages:
        """Pages in the order of time; the same object until something is added."""
        settle_all([self])
        if self._timed is None:
            self._timed = TimedPages(self.kept, self.tiers)
        return self._timed


def settle_all(timelines: Iterable[Timeline], least: int = 1) -> None:
    """Settle those timelines, of one grid, on which at least so many pages wait: quicker than one by one."""
    some = [timeline for timeline in timelines if timeline.waiting >= least]
    if some:
        blocks = [(timeline.kept, timeline.fresh) for timeline in some]
        for timeline, pages in zip(some, settled(blocks, some[0].tiers, some[0].space), strict=True):
            timeline.keep(pages)


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
