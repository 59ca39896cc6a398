"""The location of a store's journal; only this module makes journals and readers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mapserver.journal.archive import FOLDER, Archive
from mapserver.journal.journal import Journal, JournalQueries, JournalReader, Waiting
from mapserver.journal.postgres import MARK_FILE
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.disk.high_water_mark import Traces, look_beside
from protocol.disk.write_ahead_log import LogScan
from protocol.errors import ConfigError, one_line

JOURNAL_FILE = "journal.db"


@dataclass(frozen=True)
class JournalLocation:
    """The journal of one store.

    folder: of the server, with snapshots, checkpoints, archive. url: of a PostgreSQL database that servers share, with
    the folder as a cache; "" for a file in the folder.
    """

    folder: Path
    url: str = ""

    def __str__(self) -> str:
        return _postgres().connection.shown(self.url) if self.url else str(self._file)

    @property
    def is_shared(self) -> bool:
        """Whether several servers may take turns in writing."""
        return bool(self.url)

    @property
    def archive(self) -> Archive:
        """The archive of old rows."""
        return Archive(self.folder / FOLDER)

    def exists(self) -> bool:
        """Whether there is a journal."""
        return _postgres().reader.exists(self.url) if self.url else self._file.is_file()

    def open(self, site: str, frame: str, descends: Iterable[str] = (), waiting: Waiting | None = None) -> Journal:
        """Become its writer, creating it if necessary; StoreError if impossible.

        descends: ids of the stores a new one is made from. waiting: while another server writes a shared journal, else
        an error.
        """
        self._require_one()
        if self.url:
            self.folder.mkdir(parents=True, exist_ok=True)
            words = (self.url, self.folder, site, frame, descends, waiting)
            journal: Journal = _postgres().journal.PostgresJournal(*words)
            return journal
        return self.open_file(site, frame, descends)

    def open_file(self, site: str, frame: str, descends: Iterable[str] = ()) -> SqliteJournal:
        """As `open`, for a file, which may continue after an archive."""
        return SqliteJournal(self._file, site, frame, descends)

    def reader(self) -> JournalReader:
        """Open a reader; StoreError if impossible."""
        return _postgres().reader.PostgresReader(self.url) if self.url else SqliteReader(self._file)

    def file_reader(self) -> SqliteReader:
        """As `reader`, for a file, which can be copied."""
        return SqliteReader(self._file)

    def store_id(self) -> str:
        """Id of the store, "" for none; StoreError if unreadable."""
        if not self.exists():
            return ""
        with self.reader() as reader:
            return reader.identity().id

    def epoch(self) -> int:
        """Epoch of the newest writer; StoreError if unreadable."""
        with self.reader() as reader:
            return reader.state().epoch

    def prepared_id(self, site: str, frame: str) -> str:
        """As `store_id`, before waiting for a turn; creates a shared journal, so that servers agree on its id."""
        if self.url:
            self._require_one()
            _postgres().journal.prepare(self.url, self.folder, site, frame)
        return self.store_id()

    def trusted_row(self, journal: JournalQueries) -> int:
        """As `Journal.trusted_row`, before opening to write."""
        return int(_postgres().mark.trusted_row(self.folder, journal)) if self.url else journal.last_row

    def traces(self, *, in_use: bool) -> Traces:
        """Traces of how far it once was. in_use: a server has examined its log."""
        if self.url:
            mark: Traces = _postgres().mark.traces_in(self.folder)
            return mark
        traces = look_beside(self._file)
        return replace(traces, log=LogScan()) if in_use else traces

    def _require_one(self) -> None:
        """ConfigError if the folder belongs to another journal, with its snapshots."""
        if self.url and self._file.exists():
            raise ConfigError(self.folder, f"has a {JOURNAL_FILE} of its own; choose another --store for --journal")
        if not self.url and (self.folder / MARK_FILE).exists():
            problem = "is beside a journal in PostgreSQL; give its --journal, or choose another --store"
            raise ConfigError(self.folder, problem)

    @property
    def _file(self) -> Path:
        return self.folder / JOURNAL_FILE


def _postgres() -> Any:
    """Modules of the extra `postgres`; ConfigError if not installed."""
    try:
        from mapserver.journal import postgres
        from mapserver.journal.postgres import connection, journal, mark, reader  # noqa: F401
    except ImportError as error:
        advice = "a journal in PostgreSQL needs psycopg: pip install '.[postgres]'"
        raise ConfigError("--journal", f"{advice} ({one_line(str(error))})") from None
    return postgres
