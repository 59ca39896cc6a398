"""History: archive and journal as one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

from mapserver.journal.archive import Archive
from mapserver.journal.journal import ArchivedError, JournalQueries
from mapserver.journal.records import checksum_of, record
from mapserver.journal.rows import ALL, LAST, JournalRow, JournalRows, Selection


@dataclass(frozen=True)
class History:
    """All rows of one store. Used by one thread at a time, as its journal's connection is."""

    journal: JournalQueries
    archive: Archive

    def row_checksum(self, row: int) -> int | None:
        """As of a journal; of rows that were archived, too: those are the same, bit for bit."""
        if (checksum := self.journal.row_checksum(row)) is not None or not 0 < row <= self.journal.archived_row:
            return checksum
        return next((checksum_of(record(each)) for each in history_rows(self, row - 1, row)), None)


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
