"""The pages of one block by time: the newest buckets apart, older ones summed into hours, days and all before.

What stays apart is decided by rank, cell by cell, not by age: ground that is driven once a day keeps its last passes
apart as well as the haul road beside it, and a cell never takes more than a fixed number of places. The newest buckets
of a set do not depend on the order in which they came, and sums commute, so that a timeline is a function of the
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
PATIENCE = 8  # pages that a tier takes before it hands on: fewer cost time, more cost memory
Block = tuple[int, int]  # column and row


@dataclass(frozen=True)
class Tier:
    """Spans of one length [ns], of which the newest `keep` of each cell stay apart; keep 0: all of them are one."""

    span_ns: int
    keep: int


@dataclass(frozen=True, slots=True)
class TimedPage:
    """A page, and the span of time in which its samples lie."""

    first_ns: int
    end_ns: int
    page: Page


def tiers(config: FoldConfig) -> tuple[Tier, ...]:
    """Buckets, hours, days, and everything before them."""
    return (
        Tier(config.bucket_ns, config.keep_buckets),
        Tier(HOUR_S * 10**9, config.keep_hours),
        Tier(DAY_S * 10**9, config.keep_days),
        Tier(0, 0),
    )


class Timeline:
    """Pages of one block. What is beyond the newest of a tier moves on after a few pages, and before a read."""

    def __init__(self, tiers: tuple[Tier, ...]) -> None:
        self._tiers = tiers
        self._pages: tuple[dict[int, Page], ...] = tuple({} for _ in tiers)
        self._added = [0] * len(tiers)  # pages since the tier last handed on

    def add(self, bucket: int, page: Page) -> None:
        """Add evidence of a time bucket."""
        self._put(0, bucket, page)

    def put(self, tier: int, index: int, page: Page) -> None:
        """Put a page back to the place that `items` gave."""
        self._pages[tier][index] = page

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Tier, index in it, and page, sorted."""
        for tier, added in enumerate(self._added):  # the finest first: it hands on to the others
            if added:
                self._thin(tier)
        for tier, pages in enumerate(self._pages):
            for index in sorted(pages):
                yield tier, index, pages[index]

    def timed(self) -> list[TimedPage]:
        """Pages in the order of time.

        A page of a coarser tier may begin before one of a finer tier ends: both have evidence of the same hour. In each
        cell, the finer one is newer.
        """
        pages = []
        for tier, index, page in self.items():
            span = self._tiers[tier].span_ns
            end = (index + 1) * span if span else int(page.cells["newest_ns"].max()) + 1
            pages.append((-tier, TimedPage(index * span, end, page)))
        return [timed for _, timed in sorted(pages, key=lambda item: (item[0], item[1].first_ns))]

    def _put(self, tier: int, index: int, page: Page) -> None:
        pages = self._pages[tier]
        pages[index] = merge(pages[index], page) if index in pages else page
        self._added[tier] += 1
        if self._added[tier] >= PATIENCE:
            self._thin(tier)

    def _thin(self, tier: int) -> None:
        """Move what cells have beyond their newest `keep` spans to the next tier."""
        self._added[tier] = 0
        pages, keep = self._pages[tier], self._tiers[tier].keep
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
                self._put(tier + 1, self._above(tier, index), page)
                continue
            pages[index] = pick(page, kept)
            self._put(tier + 1, self._above(tier, index), pick(page, beyond[i]))

    def _above(self, tier: int, index: int) -> int:
        """Index of the coarser span that holds this one."""
        span = self._tiers[tier + 1].span_ns
        return index * self._tiers[tier].span_ns // span if span else 0
