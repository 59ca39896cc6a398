"""Settles the records of many blocks at once, keeping each cell's newest spans apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.buffers import Buffers
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.pages import CELL, TIERS, Record, as_numbers, cut
from mapserver.evidence.timeline_kernel import settle_blocks
from protocol.arrays import Ints

HOUR_S, DAY_S = 3600, 86_400
MOST_BYTES = 1 << 20  # records settled together, to stay in the processor's cache
# Lower bounds in bytes of a page, cell and vote; upper bound of growth.
_PAGE, _CELL, _VOTE, _LONGER = 32, 4, 3, 7


@dataclass(frozen=True)
class Tiers:
    """Spans of growing lengths [ns]; each cell keeps the newest `keeps` apart; the last has no end."""

    spans_ns: Ints
    keeps: Ints

    @classmethod
    def from_config(cls, config: FoldConfig) -> Tiers:
        """Buckets, hours, days, and all before."""
        spans = (config.bucket_ns, HOUR_S * 10**9, DAY_S * 10**9, 0)
        return cls(np.array(spans), np.array((config.keep_buckets, config.keep_hours, config.keep_days, 0)))


class Space(Buffers):
    """Working memory of one thread. counts: of one block, zero in between."""

    def __init__(self) -> None:
        super().__init__()
        self.counts = np.zeros(ev.COUNTS * ev.CELLS, np.uint64)

    def for_block(self, most: int) -> tuple[object, ...]:
        """Scratch of `settle_blocks`, for records of at most these bytes in a block."""
        # one more, because kernels write ahead
        pages, votes, cells = most // _PAGE + 1, most // _VOTE + 1, most // _CELL + 1
        before = self.array("table", pages, np.int64, 6), self.array("votes", votes, np.uint64)
        after = self.array("out table", TIERS * pages, np.int64, 6), self.array("out votes", votes, np.uint64)
        cells_of_both = self.array("cells", cells, CELL), self.array("out cells", cells, CELL)
        tiers = self.array("tiers", cells, np.int8)
        return (*before, cells_of_both[0]), (*after, cells_of_both[1]), tiers, self.counts


def settled(blocks: Sequence[Sequence[Record]], tiers: Tiers, space: Space) -> list[Record]:
    """One record for each block, pages by tier and index."""
    return [record for some in _few(blocks) for record in _settled(some, tiers, space)]


def _few(blocks: Sequence[Sequence[Record]]) -> Iterator[Sequence[Sequence[Record]]]:
    first, size = 0, 0
    for i, records in enumerate(blocks):
        size += sum(map(len, records))
        if size >= MOST_BYTES or i + 1 == len(blocks):
            yield blocks[first : i + 1]
            first, size = i + 1, 0


def _settled(blocks: Sequence[Sequence[Record]], tiers: Tiers, space: Space) -> list[Record]:
    records = list(chain.from_iterable(blocks))
    starts = np.cumsum([0, *map(len, records)])
    ends = np.cumsum([len(records) for records in blocks])
    out, out_ends = space.array("records", int(_LONGER * starts[-1]), np.uint8), np.empty_like(ends)
    scratch = space.for_block(int(np.diff(starts[ends], prepend=0).max()))
    data = as_numbers(b"".join(records))
    settle_blocks(ends, starts, data, tiers.spans_ns, tiers.keeps, scratch, as_numbers(out), out_ends)
    return cut(out, out_ends)
