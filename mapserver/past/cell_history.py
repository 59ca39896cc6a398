"""The history of one cell: its evidence by span of time, each span on its own.

All spans are folded at once, as buckets: one page per span.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold import Scratch, fold
from mapserver.evidence.fold_config import STD_FLOOR_M
from mapserver.evidence.grid import PIECE
from mapserver.evidence.pages import Pages
from mapserver.journal.journal import JournalReader
from mapserver.journal.rows import ALL, Selection
from mapserver.past.past import NamedSamples, StorePast, reach_of
from protocol.arrays import AnyArray, Bools, Ints, Table
from protocol.site.geometry import BLOCK_CELLS, CellWindow

Cell = tuple[int, int]  # column, row


@dataclass(frozen=True)
class CellHistory:
    """Evidence of one cell by span, oldest first, without empty spans.

    first_ns, last_ns (n,): of each span, inclusive. evidence: as Evidence, (n, 1, ...).
    """

    first_ns: Ints
    last_ns: Ints
    evidence: ev.Evidence


def cell_history(
    past: StorePast, reader: JournalReader, cell: Cell, span_ns: int, selection: Selection = ALL
) -> CellHistory:
    """The history of a cell in spans that begin at multiples of span_ns.

    selection: time and machines; its bounds are ignored.
    """
    selection = replace(selection, bounds=reach_of(CellWindow(*cell, 1, 1), past.cell_m, past.config))
    scratch = Scratch()
    parts = [
        part
        for samples in past.samples(reader, selection)
        for some in _pieces(*samples)
        for part in _evidence(past, cell, span_ns, some, scratch)
    ]
    empty: _Part = tuple(np.empty((0, *shape), kind) for shape, kind in _SHAPES)
    numbers, counts, bitmaps, newest_ns = (np.concatenate(columns) for columns in zip(empty, *parts, strict=True))
    spans, at = np.unique(numbers, return_inverse=True)
    sums, bits, newest = (np.zeros((len(spans), *shape), kind) for shape, kind in _SHAPES[1:])
    np.add.at(sums, at, counts)
    np.bitwise_or.at(bits, at, bitmaps)
    np.maximum.at(newest, at, newest_ns)
    evidence = ev.Evidence(sums[:, None], bits[:, None], newest[:, None], np.zeros((len(spans), 1), np.int64))
    return CellHistory(spans * span_ns, (spans + 1) * span_ns - 1, evidence)


_Part = tuple[AnyArray, ...]  # span numbers (n,), and the cell's counts, bitmaps and newest stamps
_SHAPES = (((), np.int64), ((ev.COUNTS,), np.uint64), ((2,), np.uint64), ((), np.int64))


def _pieces(samples: Table, names: NDArray[np.uint64]) -> Iterator[NamedSamples]:
    """Pieces whose total weight stays far below COUNT_MAX."""
    for first in range(0, len(samples), PIECE):
        yield samples[first : first + PIECE], names[first : first + PIECE]


def _evidence(past: StorePast, cell: Cell, span_ns: int, some: NamedSamples, scratch: Scratch) -> Iterator[_Part]:
    """The cell's evidence by span, from some samples."""
    samples, names = some
    near = _near(samples, cell, past.cell_m)
    samples, names = samples[near], names[near]
    numbers, spans = np.unique(samples["stamp_ns"] // span_ns, return_inverse=True)
    block = cell[0] // BLOCK_CELLS, cell[1] // BLOCK_CELLS
    place = cell[1] % BLOCK_CELLS * BLOCK_CELLS + cell[0] % BLOCK_CELLS
    if len(samples):
        for folded, record in fold(samples, names, past.cell_m, past.config, scratch, spans):
            if folded == block:
                yield _of_cell(Pages.unpacked(record), place, numbers)


def _of_cell(pages: Pages, place: int, numbers: Ints) -> _Part:
    """One cell of a block's pages. numbers: spans of their indices."""
    n, table = len(pages.table), pages.table
    page = np.repeat(np.arange(n), table[:, 3] - table[:, 2])
    here = pages.votes & np.uint64(0xFF) == place
    votes = pages.votes[here]
    counts = np.zeros((n, ev.COUNTS), np.uint64)
    counts[page[here], (votes >> np.uint64(8) & np.uint64(0xFF)).astype(np.int64)] = votes >> np.uint64(16)
    page = np.repeat(np.arange(n), table[:, 5] - table[:, 4])
    here = pages.cells["cell"] == place
    bitmaps, newest_ns = np.zeros((n, 2), np.uint64), np.zeros(n, np.int64)
    for column, name in ((ev.VISITS, "visits"), (ev.MACHINES, "machines")):
        bitmaps[page[here], column] = pages.cells[name][here]
    newest_ns[page[here]] = pages.cells["newest_ns"][here]
    known = newest_ns > 0
    return numbers[table[:, 1]][known], counts[known], bitmaps[known], newest_ns[known]


def _near(samples: Table, cell: Cell, cell_m: float) -> Bools:
    """Samples that may vote for a cell: most positions are too certain. One cell more for rounding."""
    variance = np.maximum(samples["cov_xx_m2"], samples["cov_yy_m2"]).astype(np.float64) + STD_FLOOR_M**2
    reach_m = 2 * np.sqrt(variance) + 2 * cell_m
    near: Bools = np.abs(samples["x_m"] - (cell[0] + 0.5) * cell_m) <= reach_m
    near &= np.abs(samples["y_m"] - (cell[1] + 0.5) * cell_m) <= reach_m
    return near
