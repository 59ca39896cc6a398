"""Sums of pages: the evidence of whole blocks, or of the pages from which on it holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import pick
from mapserver.evidence.timeline import TimedPage
from protocol.arrays import Ints


def evidence(pages: Sequence[Sequence[TimedPage]], first: Sequence[Ints] | None = None) -> ev.Evidence:
    """Sum the pages of blocks, in the order of time.

    first: for each block, index (256,) of the first page that counts in each of its cells; without it all pages count.
    """
    counts = np.zeros((len(pages), ev.COUNTS, ev.CELLS), np.uint64)
    bitmaps = np.zeros((len(pages), ev.CELLS, 2), np.uint64)
    newest_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    changed_ns = np.zeros((len(pages), ev.CELLS), np.int64)
    for i, block_pages in enumerate(pages):
        start = first[i] if first else np.zeros(ev.CELLS, np.int64)
        _sum(block_pages, start, counts[i].reshape(-1), bitmaps[i], newest_ns[i])
        if start.any():
            changed_ns[i] = _changed_ns(block_pages, start)
    return ev.Evidence(counts.transpose(0, 2, 1), bitmaps, newest_ns, changed_ns)


def _sum(
    pages: Sequence[TimedPage], start: Ints, counts: NDArray[np.uint64], bitmaps: NDArray[np.uint64], newest_ns: Ints
) -> None:
    last = int(start.max(initial=0))
    for index, timed in enumerate(pages):
        page = timed.page if index >= last else pick(timed.page, start <= index)
        page.add_to(counts, bitmaps, newest_ns)


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
