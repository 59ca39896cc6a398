"""A map folded again with other facts, beside the one that goes on; in a process that writes, or in one that follows.

It begins with the newest checkpoint whose evidence the facts leave as it is, which is recent where they are about
recent samples alone, and else with nothing. What comes in meanwhile is folded in rounds, until a few rows are left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mapserver.evidence.grid import Grid
from mapserver.journal.facts import Facts
from mapserver.journal.history import History
from mapserver.journal.journal import JournalReader
from mapserver.journal.refold import fold_history, fold_samples
from mapserver.journal.rows import LAST, Selection
from mapserver.past.past import Past

FEW_ROWS = 8  # may be left to whoever goes on with the map: some ms
MOST_ROUNDS = 20  # where batches come in as fast as they are folded, whoever goes on has to make them wait


@dataclass(frozen=True)
class FoldedAnew:
    """A grid up to a journal row, and how many rounds it took."""

    grid: Grid
    row: int
    rounds: int


def fold_anew(past: Past, reader: JournalReader, facts: Facts, stopped: Callable[[], bool]) -> FoldedAnew | None:
    """Fold the map with these facts, up to a row that few are behind; None where `stopped` said so."""
    begun = _begun(past, reader, facts, stopped)
    if begun is None:
        return None
    (grid, row), history, selection, rounds = begun, History(reader, past.archive), Selection.by(facts), 0
    while (last := reader.last_row) - row > FEW_ROWS and rounds < MOST_ROUNDS:
        if not fold_history(grid, history, row, last, selection, stopped):
            return None
        row, rounds = last, rounds + 1
    return FoldedAnew(grid, row, rounds)


def _begun(past: Past, reader: JournalReader, facts: Facts, stopped: Callable[[], bool]) -> tuple[Grid, int] | None:
    """The map up to a journal row that a checkpoint makes quick, or an empty one; None where it is not wanted."""
    last = reader.last_row
    grid, base = past.nearest(reader, LAST, None, facts)
    if base is None:
        return grid, 0
    samples = past.lacking(reader, base, Selection.by(facts), last)
    return (grid, last) if fold_samples(grid, samples, stopped) else None
