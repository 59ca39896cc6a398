"""Where the journal of a store is: the one place that makes journals and readers, and knows which database it is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from mapserver.journal.archive import FOLDER, Archive
from mapserver.journal.journal import Journal, JournalReader
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SCHEMA, SqliteReader
from protocol.disk.traces import Traces, look_beside
from protocol.disk.write_ahead_log import LogScan

__all__ = ["JOURNAL_FILE", "SCHEMA", "JournalLocation"]
JOURNAL_FILE = "journal.db"


@dataclass(frozen=True)
class JournalLocation:
    """The journal of the store in a folder. folder: has snapshots, checkpoints and archive too."""

    folder: Path

    def __str__(self) -> str:
        return str(self._file)

    @property
    def archive(self) -> Archive:
        """The files that old rows move to."""
        return Archive(self.folder / FOLDER)

    def exists(self) -> bool:
        """Whether there is one."""
        return self._file.is_file()

    def open(self, site: str, frame: str, descends: Iterable[str] = ()) -> Journal:
        """Become its writer, and make it where there is none; StoreError says why not.

        descends: ids of the stores that a new one is made from.
        """
        return SqliteJournal(self._file, site, frame, descends)

    def reader(self) -> JournalReader:
        """Read it; StoreError where that cannot be done."""
        return SqliteReader(self._file)

    def store_id(self) -> str:
        """Id of the store; empty where there is none yet. StoreError where it cannot be read."""
        if not self.exists():
            return ""
        with self.reader() as reader:
            return reader.identity().id

    def traces(self, *, in_use: bool) -> Traces:
        """What lies beside it and tells how far it once was. in_use: by a server, which has looked at its log."""
        traces = look_beside(self._file)
        return replace(traces, log=LogScan()) if in_use else traces

    @property
    def _file(self) -> Path:
        return self.folder / JOURNAL_FILE
