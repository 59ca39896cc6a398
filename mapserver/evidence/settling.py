"""Timelines settled many at a time: what is waiting is summed with what is kept, each cell's newest spans apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.buffers import Buffers
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.pages import CELL, RAW_CELL, CompactPages, PackedPages, compact
from mapserver.evidence.timeline_kernel import settle_blocks
from protocol.arrays import Ints

HOUR_S, DAY_S = 3600, 86_400
MOST_VOTES = 1 << 17  # of blocks that are settled together: 1 MB, which stays in the processor's cache
Unsettled = tuple[CompactPages, Sequence[PackedPages]]  # pages of a block, and those that came since, at least one


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


class Space(Buffers):
    """Where one thread settles timelines. counts: of one block, zero in between."""

    def __init__(self) -> None:
        super().__init__()
        self.counts = np.zeros(ev.COUNTS * ev.CELLS, np.uint64)


def settled(blocks: Sequence[Unsettled], tiers: Tiers, space: Space) -> list[CompactPages]:
    """The pages of each block, in the order of tier and index."""
    return [pages for some in _few(blocks) for pages in _settled(some, tiers, space)]


def _few(blocks: Sequence[Unsettled]) -> Iterator[Sequence[Unsettled]]:
    """Cut blocks into pieces that are settled together."""
    first, votes = 0, 0
    for i, (kept, fresh) in enumerate(blocks):
        votes += len(kept.cells) + sum(len(pages.votes) for pages in fresh)
        if votes >= MOST_VOTES:
            yield blocks[first : i + 1]
            first, votes = i + 1, 0
    if first < len(blocks):
        yield blocks[first:]


def _settled(blocks: Sequence[Unsettled], tiers: Tiers, space: Space) -> list[CompactPages]:
    kept, fresh = CompactPages.joined([pages for pages, _ in blocks]), [one for _, some in blocks for one in some]
    lengths = [(len(one.votes), len(one.cells)) for one in fresh]
    until = np.cumsum([(len(kept.cells), len(kept.marks)), *lengths], axis=0)
    (votes, cells), (all_votes, all_cells) = until[0].tolist(), until[-1].tolist()
    array = space.array
    raw_votes, raw_cells = array("votes", all_votes, np.uint64), array("cells", all_cells, RAW_CELL)
    kept_table = kept.table.astype(np.int64)
    kept.expand_into(PackedPages(kept_table, raw_votes[:votes], raw_cells[:cells].view(CELL)))
    np.concatenate([one.votes for one in fresh], out=raw_votes[votes:])
    np.concatenate([one.cells.view(RAW_CELL) for one in fresh], out=raw_cells[cells:])
    fresh_table = np.concatenate([one.table for one in fresh])
    fresh_pages = [len(one.table) for one in fresh]
    fresh_table[:, 2:] += np.repeat(until[:-1, [0, 0, 1, 1]], fresh_pages, axis=0)
    numbers = np.arange(len(blocks))
    owners = np.concatenate(
        [
            np.repeat(numbers, [len(pages.table) for pages, _ in blocks]),
            np.repeat(np.repeat(numbers, [len(some) for _, some in blocks]), fresh_pages),
        ]
    )
    table = np.concatenate([kept_table, fresh_table])[np.argsort(owners, kind="stable")]
    ends = np.bincount(owners, minlength=len(blocks)).cumsum()
    out_ends, out_table = np.empty_like(ends), np.empty((len(table) * len(tiers.keeps), 6), np.int64)
    # one more of each: the kernel writes one place ahead
    out_votes, out_cells = array("out votes", all_votes + 1, np.uint64), array("out cells", all_cells + 1, CELL)
    pages, used, filled = settle_blocks(
        ends, table, raw_votes, raw_cells.view(CELL), tiers.spans_ns, tiers.keeps, space.counts,
        array("tiers", all_cells, np.int8), out_ends, out_table, out_votes, out_cells,
    )  # fmt: skip
    return compact(out_ends, out_table[:pages], out_votes[:used], out_cells[:filled], space)
