"""How far a journal was read, and whether it is still the one that was read.

A row that was read may be gone when the journal is looked at again: a store that was restored, a database that failed
over. It is noticed by the id of the store, by numbers and checksums of the last row (in journal or archive) and of the
last event, and by an epoch that is lower than before. A replica of a database that is behind another one has not lost
anything.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mapserver.journal.archive import Archive
from mapserver.journal.history import History, read_history
from mapserver.journal.journal import JournalQueries, JournalReader, JournalState
from mapserver.journal.records import last_checksum
from mapserver.journal.rows import Event, JournalRows
from protocol.errors import StoreError


class Tail:
    """Rows and events of one journal beyond the last ones that were read: `row`, `event`. Used by one thread at a time.

    store: the journal's id. problem: why there was no further row, None where there was none.
    """

    def __init__(self, reader: JournalReader, archive: Archive) -> None:
        self.store, self._archive, self._epoch = reader.identity().id, archive, reader.state().epoch
        self.row = self.event = 0
        self.problem: StoreError | OSError | None = None
        self._checksum: int | None = None  # that the last row was written with, None where that is not known
        self._event_checksum: int | None = None
        self._compared: object = None  # where the last row was in the archive when it was compared

    def rows(self, reader: JournalReader, until: int) -> Iterator[JournalRows]:
        """The next rows up to `until`, many at a time; up to the first that cannot be read, which is a `problem`."""
        self.problem = None
        try:
            for rows in read_history(History(reader, self._archive), self.row, until):
                self.row, self._checksum = int(rows.numbers[-1]), last_checksum(rows)
                yield rows
        except (StoreError, OSError) as error:
            self.problem = error

    def skip_to(self, reader: JournalReader, row: int) -> None:
        """Go on behind a row that was read by others, as into a snapshot."""
        self.row, self._checksum = row, History(reader, self._archive).row_checksum(row)

    def heard(self, events: Sequence[Event]) -> None:
        """Go on behind events, which have been taken."""
        if events:
            self.event, self._event_checksum = events[-1].id, events[-1].checksum

    def lags(self, reader: JournalReader, state: JournalState) -> bool:
        """Whether the journal is read from a replica of the database that is behind another one, read before.

        Where rows are gone for good, the server that goes on has a higher epoch.
        """
        lacks = state.row < self.row or state.event < self.event or state.epoch < self._epoch
        return lacks and reader.is_replica and state.epoch <= self._epoch and reader.identity().id == self.store

    def is_gone(self, reader: JournalReader, state: JournalState) -> bool:
        """Whether the journal lacks what was read of it."""
        is_gone = (
            reader.identity().id != self.store
            or state.row < self.row
            or state.event < self.event
            or _is_other(reader.event_checksum(self.event), self._event_checksum)
            or state.epoch < self._epoch
            or self._is_another_row(reader)
        )
        self._epoch = state.epoch
        return is_gone

    def is_in(self, journal: JournalQueries) -> bool:
        """Whether a journal has the last row that was read, and not another one of its number."""
        return self.row <= journal.last_row and (
            self.row <= journal.archived_row or journal.row_checksum(self.row) == self._checksum
        )

    def _is_another_row(self, reader: JournalReader) -> bool:
        checksum = reader.row_checksum(self.row)
        if checksum is None and self._checksum is not None:
            checksum = self._archived_checksum(reader)
        return _is_other(checksum, self._checksum)

    def _archived_checksum(self, reader: JournalReader) -> int | None:
        """Of the last row in the archive, which is read once; None where nothing new can be said."""
        archive = Archive(self._archive.folder)  # with no file open: another one may have taken the place of one
        try:
            (file,) = archive.cover(self.row, self.row - 1)
            stat = file.stat()
            if (seen := (self.row, file, stat.st_ino, stat.st_mtime_ns)) == self._compared:
                return None
            checksum, self._compared = History(reader, archive).row_checksum(self.row), seen
        except (StoreError, OSError):  # who needs the file says so
            return None
        return checksum


def _is_other(there: int | None, known: int | None) -> bool:
    """Whether two checksums of one number are known, and differ: the journal has diverged."""
    return None not in (there, known) and there != known
