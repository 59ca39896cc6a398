"""Folds samples of many machines: sorted by block and bucket, each summed into one page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.buffers import Buffers
from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.fold_kernels import BUCKET_BITS, fold_sorted
from mapserver.evidence.pages import CELL, Record, most_bytes, records
from mapserver.evidence.sample_kernels import locate, split, weigh
from protocol.arrays import AnyArray, Ints, Table

MOST_SHARES = 1 << 24  # stencil shares per call, 64 MB
MOST_VOTES = 1 << 20  # votes packed at once, 8 MB
MOST_PAGES = 1 << 14  # pages packed at once
_VOTES_OF_CELL = 9  # two bins of three values each, sector, doubt, aided


class Scratch(Buffers):
    """Memory of one thread. block: unpacked, zero between folds."""

    def __init__(self) -> None:
        super().__init__()
        counts, lines = np.zeros(ev.COUNTS * ev.CELLS, np.uint32), np.zeros(ev.COUNTS, np.int32)
        bits, newest = (np.zeros(ev.CELLS, np.uint64) for _ in range(2)), np.zeros(ev.CELLS, np.int64)
        self.block: tuple[AnyArray, ...] = (counts, lines, *bits, newest)


def fold(
    rows: Table,
    names: NDArray[np.uint64],
    cell_m: float,
    config: FoldConfig,
    scratch: Scratch,
    spans: Ints | None = None,
) -> Iterator[tuple[tuple[int, int], Record]]:
    """Fold samples; yields blocks, repeatedly maybe, with records of their buckets (tier 0).

    names (n,): hashes of machine names. The total weight stays within COUNT_MAX. Uncertain positions have no vote.
    spans (n,): pages below 2**BUCKET_BITS in place of buckets.
    """
    limits = (cell_m, STD_FLOOR_M**2, config.std_cap_m**2)
    n = len(rows)
    array = scratch.array
    places, stencils = array("places", n, np.float64, 5), array("stencils", n, np.int64, 3)
    keys, touching = array("keys", 3 * n + 16, np.int64), array("touching", 3 * n + 16, np.int32)
    pairs, area = locate(rows, limits, config.bucket_ns, places, stencils, keys, touching)
    if pairs > len(keys):
        keys, touching = array("keys", pairs, np.int64), array("touching", pairs, np.int32)
        locate(rows, limits, config.bucket_ns, places, stencils, keys, touching)
    if area > MOST_SHARES and n > 1:  # tiny cells under uncertain positions
        for part in (slice(n // 2), slice(n // 2, None)):
            yield from fold(
                rows[part], names[part], cell_m, config, scratch, spans[part] if spans is not None else None
            )
        return
    if spans is not None:
        keys[:pairs] = keys[:pairs] >> BUCKET_BITS << BUCKET_BITS | spans[touching[:pairs]]
    starts, shares = array("starts", n, np.int64), array("shares", area, np.uint32)
    weigh(rows, places, stencils, starts, shares)
    bins, bin_shares = array("bins", n, np.int64, 4), array("bin_shares", n, np.uint32, 5)
    bits, stamps = array("bits", n, np.uint64, 2), array("stamps", n, np.int64)
    split(rows, names, bins, bin_shares, bits, stamps)
    order = np.argsort(keys[:pairs], kind="stable")
    keys = np.take(keys, order, out=array("sorted keys", pairs, np.int64))
    touching = np.take(touching, order, out=array("sorted touching", pairs, np.int32))
    samples = (stencils, starts, shares, bins, bin_shares, bits, stamps)
    yield from _pages(keys, touching, samples, area, scratch)


def _pages(
    keys: Ints, touching: Ints, samples: tuple[Any, ...], area: int, scratch: Scratch
) -> Iterator[tuple[tuple[int, int], Record]]:
    """In pieces that fit the working memory."""
    block = ev.COUNTS * ev.CELLS
    pages = scratch.array("pages", min(len(keys), MOST_PAGES), np.int64, 8)
    votes = scratch.array("votes", min(_VOTES_OF_CELL * area, MOST_VOTES) + block, np.uint64)
    cells = scratch.array("cells", min(area, len(pages) * ev.CELLS) + ev.CELLS, CELL)
    done = 0
    while done < len(keys):
        done, n, used, filled = fold_sorted(done, keys, touching, samples, scratch.block, pages, votes, cells)
        yield from _by_block(pages[:n], votes[:used], cells[:filled], scratch)


def _by_block(
    pages: Ints, votes: NDArray[np.uint64], cells: Table, scratch: Scratch
) -> Iterator[tuple[tuple[int, int], Record]]:
    firsts = np.flatnonzero((np.diff(pages[:, :2], axis=0, prepend=pages[:1, :2] - 1) != 0).any(axis=1))
    ends, table = np.append(firsts[1:], len(pages)), pages[:, 2:].copy()
    space = scratch.array("records", most_bytes(table, votes, cells), np.uint8)
    blocks = zip(*pages[firsts, :2].T.tolist(), strict=True)
    yield from zip(blocks, records(ends[: len(firsts)], table, votes, cells, space), strict=True)
