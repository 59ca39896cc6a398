"""The pages of one block by time: the newest buckets apart, older ones summed into hours, days and all before.

What is kept apart goes by rank, cell by cell, not by age: ground that is driven once a day keeps its last passes apart
as well as the haul road beside it, and a cell never takes more than a fixed number of places. The newest buckets of
a set do not depend on the order in which they came, and summing commutes, so that a ladder is a function of the
samples alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import Page, merge, pick
from mapserver.evidence.votes import FoldConfig
from protocol.arrays import Bools

HOUR_S, DAY_S = 3600, 86_400
PATIENCE = 8  # pages that a rung takes before it hands on: fewer cost time, more cost memory
Block = tuple[int, int]  # column and row


@dataclass(frozen=True)
class Rung:
    """Spans of one length [ns], of which the newest `keep` of each cell stay apart; keep 0: all of them are one."""

    span_ns: int
    keep: int


@dataclass(frozen=True, slots=True)
class TimedPage:
    """A page, and the span of time that its samples lie in."""

    first_ns: int
    end_ns: int
    page: Page


def rungs(config: FoldConfig) -> tuple[Rung, ...]:
    """Buckets, hours, days, and everything before them."""
    return (
        Rung(config.bucket_ns, config.keep_buckets),
        Rung(HOUR_S * 10**9, config.keep_hours),
        Rung(DAY_S * 10**9, config.keep_days),
        Rung(0, 0),
    )


class Ladder:
    """Pages of one block. What is beyond the newest of a rung is handed on after a few pages, and before reading."""

    def __init__(self, rungs: tuple[Rung, ...]) -> None:
        self._rungs = rungs
        self._pages: tuple[dict[int, Page], ...] = tuple({} for _ in rungs)
        self._taken = [0] * len(rungs)  # pages since the rung handed on

    def add(self, bucket: int, page: Page) -> None:
        """Add evidence of a time bucket."""
        self._put(0, bucket, page)

    def put(self, rung: int, index: int, page: Page) -> None:
        """Put a page back where `items` found it."""
        self._pages[rung][index] = page

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Rung, index on it, and page, sorted."""
        for rung, taken in enumerate(self._taken):  # the finest first: it hands on to the others
            if taken:
                self._thin(rung)
        for rung, pages in enumerate(self._pages):
            for index in sorted(pages):
                yield rung, index, pages[index]

    def timed(self) -> list[TimedPage]:
        """Pages in the order of time.

        A page of a coarser rung may begin before one of a finer rung ends: both have evidence of the same hour. In each
        cell, the finer one is newer.
        """
        found = []
        for rung, index, page in self.items():
            span = self._rungs[rung].span_ns
            end = (index + 1) * span if span else int(page.cells["newest_ns"].max()) + 1
            found.append((-rung, TimedPage(index * span, end, page)))
        return [timed for _, timed in sorted(found, key=lambda item: (item[0], item[1].first_ns))]

    def _put(self, rung: int, index: int, page: Page) -> None:
        pages = self._pages[rung]
        pages[index] = merge(pages[index], page) if index in pages else page
        self._taken[rung] += 1
        if self._taken[rung] >= PATIENCE:
            self._thin(rung)

    def _thin(self, rung: int) -> None:
        """Hand on what cells have beyond their newest `keep` spans."""
        self._taken[rung] = 0
        pages, keep = self._pages[rung], self._rungs[rung].keep
        if not keep or len(pages) <= keep:
            return
        order = sorted(pages, reverse=True)
        held: Bools = np.zeros((len(order), ev.CELLS), np.bool_)
        for i, index in enumerate(order):
            held[i, pages[index].cells["cell"]] = True
        beyond = held & (held.cumsum(axis=0) > keep)
        for i in np.flatnonzero(beyond.any(axis=1)).tolist():
            index = order[i]
            page = pages.pop(index)
            if not (kept := held[i] & ~beyond[i]).any():
                self._put(rung + 1, self._above(rung, index), page)
                continue
            pages[index] = pick(page, kept)
            self._put(rung + 1, self._above(rung, index), pick(page, beyond[i]))

    def _above(self, rung: int, index: int) -> int:
        """Index of the coarser span that holds this one."""
        span = self._rungs[rung + 1].span_ns
        return index * self._rungs[rung].span_ns // span if span else 0
