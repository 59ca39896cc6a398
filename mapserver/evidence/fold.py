"""Samples of many machines folded at once: sorted by block and time bucket, each of these summed into one page."""

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

MOST_SHARES = 1 << 24  # of stencils that are weighed at once, 64 MB
MOST_VOTES = 1 << 20  # that are packed at once, 8 MB
MOST_PAGES = 1 << 14  # likewise
_VOTES_OF_CELL = 9  # two bins of each of three values, one sector, the doubt, and what is aided


class Scratch(Buffers):
    """Where one thread folds. block: one block unpacked, where kernels sum, zero between folds."""

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
    """Fold samples; yields a block and a record of its buckets (tier 0), a block maybe more than once.

    names (n,): hashes of the rows' machines. The weight of all samples together stays within COUNT_MAX. Samples that
    do not know their place well enough have no vote. spans (n,): numbers below 2**BUCKET_BITS of the pages that the
    rows count in, in place of their buckets.
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
    if area > MOST_SHARES and n > 1:  # tiny cells under unsure positions
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
    """Fold sorted pairs, as many at a time as there is space for."""
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
    """Pack the pages of each block."""
    firsts = np.flatnonzero((np.diff(pages[:, :2], axis=0, prepend=pages[:1, :2] - 1) != 0).any(axis=1))
    ends, table = np.append(firsts[1:], len(pages)), pages[:, 2:].copy()
    space = scratch.array("records", most_bytes(table, votes, cells), np.uint8)
    blocks = zip(*pages[firsts, :2].T.tolist(), strict=True)
    yield from zip(blocks, records(ends[: len(firsts)], table, votes, cells, space), strict=True)
