"""History: archive and journal as one, and maps of any time folded from them.

The samples are the truth and every map is a fold over them, so a map of the past needs no more than their stamps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import chain

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.grid import REFOLD_ROWS, Grid
from mapserver.journal.archive import FOLDER, Archive
from mapserver.journal.reader import LAST, ArchivedError, JournalQueries
from mapserver.journal.rows import ALL, JournalRow, JournalRows, Selection
from protocol.arrays import Table
from protocol.site.geometry import BLOCK_CELLS, Bounds, CellWindow, GridGeometry


@dataclass(frozen=True)
class History:
    """All rows of one store. Used by one thread at a time, as its journal's connection is."""

    journal: JournalQueries
    archive: Archive

    @classmethod
    def beside(cls, journal: JournalQueries) -> History:
        """A journal and the archive beside it."""
        return cls(journal, Archive(journal.path.parent / FOLDER))


@dataclass(frozen=True)
class SpanEvidence:
    """Evidence of one cell from samples with first_ns <= stamp <= last_ns; arrays as in Evidence, (1, 1, ...)."""

    first_ns: int
    last_ns: int
    evidence: ev.Evidence


def read_history(
    history: History, after: int = 0, until: int = LAST, selection: Selection = ALL
) -> Iterator[JournalRows]:
    """Rows after < row <= until in order, from archive and journal, each once, also while rows move between them.

    Many at a time, and never none.
    """
    while True:
        try:
            for rows in history.journal.read_many(after, until, selection):
                yield rows
                after = int(rows.numbers[-1])
        except ArchivedError as error:
            archived = min(error.archived_row, until)
        else:
            return
        yield from history.archive.read_many(after, archived, selection)
        after = archived


def history_rows(
    history: History, after: int = 0, until: int = LAST, selection: Selection = ALL
) -> Iterator[JournalRow]:
    """As `read_history`, one by one."""
    return chain.from_iterable(read_history(history, after, until, selection))


def samples_of(row: JournalRow, selection: Selection) -> Table:
    """Samples of a row that are selected by stamp and place, in their order."""
    return row.rows[selection.includes(row.rows)]


def grid_as_of(
    history: History,
    to_ns: int,
    cell_m: float,
    config: FoldConfig,
    window: CellWindow | None = None,
    without: frozenset[str] = frozenset(),
) -> Grid:
    """Fold all samples stamped `to_ns` or earlier, without the machines in `without`.

    window: only the evidence of these cells is complete, and nothing far from them is read.
    """
    bounds = _reach_of(window, cell_m, config) if window else None
    selection = Selection(to_ns=to_ns, bounds=bounds, without=without)
    grid = Grid(cell_m, config, REFOLD_ROWS)
    for row in history_rows(history, selection=selection):
        grid.fold(samples_of(row, selection), row.machine)
    return grid


def point_history(
    history: History,
    cell: tuple[int, int],
    cell_m: float,
    config: FoldConfig,
    selection: Selection = ALL,
    span_s: float | None = None,
) -> list[SpanEvidence]:
    """Evidence of one cell (column, row) over time, oldest first; spans without any are not in it.

    selection: time and machines; its bounds are not used. span_s: length of a span, a bucket where it is not given.
    """
    window = CellWindow(*cell, 1, 1)
    selection = replace(selection, bounds=_reach_of(window, cell_m, config))
    span_ns = round((span_s or config.bucket_s) * 1e9)
    parts: dict[int, dict[str, list[Table]]] = {}
    for row in history_rows(history, selection=selection):
        samples = samples_of(row, selection)
        spans = samples["stamp_ns"] // span_ns
        for span in np.unique(spans).tolist():
            parts.setdefault(span, {}).setdefault(row.machine, []).append(samples[spans == span])
    spans_of_cell = []
    for span in sorted(parts):
        evidence = _cell_evidence(parts[span], cell, cell_m, config)
        if evidence.weight.any():
            spans_of_cell.append(SpanEvidence(span * span_ns, (span + 1) * span_ns - 1, evidence))
    return spans_of_cell


def _cell_evidence(
    parts: dict[str, list[Table]], cell: tuple[int, int], cell_m: float, config: FoldConfig
) -> ev.Evidence:
    grid = Grid(cell_m, config)
    for machine, samples in parts.items():
        grid.fold(np.concatenate(samples), machine)
    column, row = cell
    block = grid.evidence([(column // BLOCK_CELLS, row // BLOCK_CELLS)])
    place = row % BLOCK_CELLS * BLOCK_CELLS + column % BLOCK_CELLS
    return ev.Evidence(**{f.name: getattr(block, f.name)[:, place : place + 1] for f in fields(block)})


def _reach_of(window: CellWindow, cell_m: float, config: FoldConfig) -> Bounds:
    """Where samples that vote in a window can lie: 3 sigma of the least certain, and a cell for rounding."""
    reach_m = 3 * math.hypot(config.std_cap_m, STD_FLOOR_M) + cell_m
    inner = GridGeometry(cell_m).bounds(window)
    return Bounds(inner.west_m - reach_m, inner.south_m - reach_m, inner.east_m + reach_m, inner.north_m + reach_m)
