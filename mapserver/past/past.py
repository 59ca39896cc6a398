"""The past of one store: samples by stamp and place, checkpoints, and maps as of any time.

A past map is the nearest earlier checkpoint plus the samples it lacks: later ones, and late ones journalled after it
was made. Folds commute, so the map is the fold of all samples up to its time, bit for bit, from any checkpoint or none.
`fold_anew` also rebuilds the map with other facts while the old one continues, from the newest unaffected checkpoint;
rows that arrive meanwhile are folded in rounds, until few are left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import STD_FLOOR_M, FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.journal.archive import FOLDER, Archive
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.history import THREADS, History, fold_history, fold_samples, lent, read_history
from mapserver.journal.journal import JournalQueries, JournalReader
from mapserver.journal.rows import LAST, JournalRows, Selection
from mapserver.journal.stamp_index import StampIndex
from mapserver.past.checkpoint_file import OPEN_END_NS, Checkpoint, DamagedError, Header
from mapserver.past.checkpoints import Checkpoints, FactsBefore
from protocol.arrays import Table
from protocol.site.geometry import Bounds, CellWindow, GridGeometry

NamedSamples = tuple[Table, NDArray[np.uint64]]  # with hashes of machine names
FEW_ROWS = 8  # rows left to whoever continues the map, some ms
MOST_ROUNDS = 20  # rounds of a fold; batches that arrive faster must be held back


@dataclass(frozen=True)
class StorePast:
    """Sources of one store's past. Thread-safe, given a journal reader per thread."""

    archive: Archive
    stamps: StampIndex
    checkpoints: Checkpoints
    cell_m: float
    config: FoldConfig
    trusted_row: Callable[[JournalQueries], int]

    @classmethod
    def of_store(
        cls,
        folder: Path,
        cell_m: float,
        config: FoldConfig,
        trusted_row: Callable[[JournalQueries], int] = lambda reader: reader.last_row,
    ) -> StorePast:
        """The past of a store's folder.

        trusted_row: checkpoints up to this row belong to the journal; a server has removed others.
        """
        return cls(Archive(folder / FOLDER), StampIndex(), Checkpoints(folder), cell_m, config, trusted_row)

    def depends_on(self, journal: JournalQueries, facts: Facts) -> FactsBefore:
        """Dependencies of evidence stamped before a time: format, fold, facts. Checkpoints with others are not used."""
        bins = [ev.RESISTANCE_BINS, ev.GRADE_BINS, ev.SECTORS]
        form = {"store": journal.identity().id, "schema": ev.SCHEMA, "cell_m": self.cell_m, "bins": bins}
        fold = {**asdict(self.config), "std_floor_m": STD_FLOOR_M}
        return lambda closed_ns: {**form, **facts.of_evidence(closed_ns), **fold}

    def samples(
        self, reader: JournalReader, selection: Selection, after: int = 0, until: int = LAST
    ) -> Iterator[NamedSamples]:
        """Selected samples of rows after < row <= until, corrected, in large pieces."""
        for rows in self.rows(reader, selection, after, until):
            yield rows.selected(selection)

    def rows(
        self, reader: JournalReader, selection: Selection, after: int = 0, until: int = LAST
    ) -> Iterator[JournalRows]:
        """Rows after < row <= until that may hold selected samples, as sent, in large pieces."""
        history = History(reader, self.archive)
        for stretch in self.stamps.stretches(reader, after, until, selection):
            yield from read_history(history, *stretch, selection)

    def lacking(
        self, reader: JournalReader, base: Header | None, selection: Selection, until: int = LAST
    ) -> Generator[NamedSamples, None, None]:
        """Selected samples of rows up to `until` that a checkpoint lacks; None for all.

        selection: no beginning, and no end before the checkpoint's.
        """
        if base is None:
            yield from self.samples(reader, selection, until=until)
        else:
            if base.closed_ns <= selection.to_ns:
                yield from self.samples(reader, replace(selection, from_ns=base.closed_ns), until=base.row)
            yield from self.samples(reader, selection, after=base.row, until=until)

    def next_stamp(self, reader: JournalReader, from_ns: int) -> int | None:
        """The least stamp since from_ns; from_ns itself inside a journal row's span."""
        stamps = (self.stamps.next_stamp(reader, from_ns), self.archive.next_stamp(from_ns))
        return min((stamp for stamp in stamps if stamp is not None), default=None)

    def late_rows(self, reader: JournalReader, header: Header) -> int:
        """Number of rows with samples stamped before a checkpoint closed, but missing from it."""
        selection = Selection(to_ns=header.closed_ns - 1)
        stretches = self.stamps.stretches(reader, header.row, LAST, selection)
        return sum(reader.rows_before(*stretch, header.closed_ns) for stretch in stretches)

    def grid(self, checkpoint: Checkpoint | None, window: CellWindow | None = None) -> Grid:
        """Evidence of a checkpoint, in a window or all; empty for None."""
        if checkpoint is None:
            return Grid(self.cell_m, self.config)
        blocks = tuple(checkpoint.blocks(checkpoint.numbers_in(window)))
        return Grid.from_state(self.cell_m, self.config, replace(checkpoint.header.state, blocks=blocks))

    def grid_as_of(
        self,
        reader: JournalReader,
        to_ns: int,
        window: CellWindow | None = None,
        facts: Facts = NO_FACTS,
        until: int = LAST,
    ) -> Grid:
        """The fold of samples stamped up to `to_ns`, with these facts, of rows up to `until` and a checkpoint's.

        window: only its cells are complete, and only nearby data is read.
        """
        grid, base = self.nearest(reader, to_ns, window, facts)
        bounds = reach_of(window, self.cell_m, self.config) if window else None
        with lent(1 if window else THREADS) as workers, grid.bulk(workers):
            for samples, names in self.lacking(reader, base, Selection.by(facts, to_ns=to_ns, bounds=bounds), until):
                grid.fold_all(samples, names)
        return grid

    def newest(self, journal: JournalQueries, facts: Facts) -> tuple[int, Grid]:
        """Row and grid of the newest valid snapshot; 0 and empty without one."""
        grid, header = self.nearest(journal, LAST, None, facts, OPEN_END_NS)
        return header.row if header else 0, grid

    def nearest(
        self, journal: JournalQueries, to_ns: int, window: CellWindow | None, facts: Facts, from_ns: int = 0
    ) -> tuple[Grid, Header | None]:
        """Evidence and header of the nearest checkpoint without later samples; empty without one.

        from_ns: earliest closing time.
        """
        before, last_row = self.depends_on(journal, facts), self.trusted_row(journal)
        while checkpoint := self.checkpoints.nearest(to_ns + 1, before, last_row, from_ns):
            with checkpoint:
                try:
                    return self.grid(checkpoint, window), checkpoint.header
                except (DamagedError, OSError) as error:
                    self.checkpoints.pass_over(checkpoint, error)
        return self.grid(None), None


def reach_of(window: CellWindow, cell_m: float, config: FoldConfig) -> Bounds:
    """Where samples that vote in a window can lie: 3 sigma of the least certain, and a cell."""
    reach_m = 3 * math.hypot(config.std_cap_m, STD_FLOOR_M) + cell_m
    inner = GridGeometry(cell_m).bounds(window)
    return Bounds(inner.west_m - reach_m, inner.south_m - reach_m, inner.east_m + reach_m, inner.north_m + reach_m)


@dataclass(frozen=True)
class FoldedAnew:
    """A rebuilt grid up to a journal row, and its rounds."""

    grid: Grid
    row: int
    rounds: int


def fold_anew(past: StorePast, reader: JournalReader, facts: Facts, stopped: Callable[[], bool]) -> FoldedAnew | None:
    """Rebuild the map with these facts, nearly up to the last row; None if `stopped`."""
    made = begun(past, reader, facts, stopped)
    if made is None:
        return None
    (grid, row), history, selection, rounds = made, History(reader, past.archive), Selection.by(facts), 0
    while (last := reader.last_row) - row > FEW_ROWS and rounds < MOST_ROUNDS:
        if not fold_history(grid, history, row, last, selection, stopped):
            return None
        row, rounds = last, rounds + 1
    return FoldedAnew(grid, row, rounds)


def begun(past: StorePast, reader: JournalReader, facts: Facts, stopped: Callable[[], bool]) -> tuple[Grid, int] | None:
    """A map from a checkpoint, with its row, or an empty one; None if `stopped`."""
    last = reader.last_row
    grid, base = past.nearest(reader, LAST, None, facts)
    if base is None or base.closed_ns == OPEN_END_NS:
        return grid, base.row if base else 0
    samples = past.lacking(reader, base, Selection.by(facts), last)
    return (grid, last) if fold_samples(grid, samples, stopped) else None
