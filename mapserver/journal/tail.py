"""How far a journal was read, and whether it has diverged since.

A restored or failed-over journal may lack rows already read. Signs: another store id, another checksum or number of the
last row or event, a lower epoch. A lagging replica has lost nothing.
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
    """Rows and events of a journal beyond the last ones read. For one thread.

    store: the journal's id. problem: why no further row was read, or None.
    """

    def __init__(self, reader: JournalReader, archive: Archive) -> None:
        self.store, self._archive, self._epoch = reader.identity().id, archive, reader.state().epoch
        self.row = self.event = 0
        self.problem: StoreError | OSError | None = None
        self._checksum: int | None = None  # of the last row, if known
        self._event_checksum: int | None = None
        self._compared: object = None  # place of the last row in the archive when compared

    def rows(self, reader: JournalReader, until: int) -> Iterator[JournalRows]:
        """The next rows up to `until`, many at a time; a row that cannot be read ends them as `problem`."""
        self.problem = None
        try:
            for rows in read_history(History(reader, self._archive), self.row, until):
                self.row, self._checksum = int(rows.numbers[-1]), last_checksum(rows)
                yield rows
        except (StoreError, OSError) as error:
            self.problem = error

    def skip_to(self, reader: JournalReader, row: int) -> None:
        """Continue after a row that others have read, for example into a snapshot."""
        self.row, self._checksum = row, History(reader, self._archive).row_checksum(row)

    def heard(self, events: Sequence[Event]) -> None:
        """Continue after events."""
        if events:
            self.event, self._event_checksum = events[-1].id, events[-1].checksum

    def lags(self, reader: JournalReader, state: JournalState) -> bool:
        """Whether a database replica lags behind one read before.

        If rows are lost for good, the next server has a higher epoch.
        """
        lacks = state.row < self.row or state.event < self.event or state.epoch < self._epoch
        return lacks and reader.is_replica and state.epoch <= self._epoch and reader.identity().id == self.store

    def is_gone(self, reader: JournalReader, state: JournalState) -> bool:
        """Whether the journal has diverged from what was read."""
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
        """Whether a journal has the last row read, with its checksum."""
        return self.row <= journal.last_row and (
            self.row <= journal.archived_row or journal.row_checksum(self.row) == self._checksum
        )

    def _is_another_row(self, reader: JournalReader) -> bool:
        checksum = reader.row_checksum(self.row)
        if checksum is None and self._checksum is not None:
            checksum = self._archived_checksum(reader)
        return _is_other(checksum, self._checksum)

    def _archived_checksum(self, reader: JournalReader) -> int | None:
        """Checksum of the last row in the archive, read once; None if unchanged."""
        archive = Archive(self._archive.folder)  # opens no file in advance, because files may be replaced
        try:
            (file,) = archive.cover(self.row, self.row - 1)
            stat = file.stat()
            if (seen := (self.row, file, stat.st_ino, stat.st_mtime_ns)) == self._compared:
                return None
            checksum, self._compared = History(reader, archive).row_checksum(self.row), seen
        except (StoreError, OSError):  # reported by others, who need the file
            return None
        return checksum


def _is_other(there: int | None, known: int | None) -> bool:
    """Whether two known checksums differ: the journal has diverged."""
    return None not in (there, known) and there != known
