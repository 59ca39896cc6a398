"""Where the journal of a store is: the one place that makes journals and readers, and knows which database it is."""

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

    folder: of the server, with snapshots, checkpoints and archive. url: of a PostgreSQL database that has the journal,
    which several servers share: the folder is a cache then. Empty where the journal is a file in the folder.
    """

    folder: Path
    url: str = ""

    def __str__(self) -> str:
        return _postgres().connection.shown(self.url) if self.url else str(self._file)

    @property
    def is_shared(self) -> bool:
        """Whether servers on several hosts may take turns in writing it."""
        return bool(self.url)

    @property
    def archive(self) -> Archive:
        """The files that old rows move to."""
        return Archive(self.folder / FOLDER)

    def exists(self) -> bool:
        """Whether there is one."""
        return _postgres().reader.exists(self.url) if self.url else self._file.is_file()

    def open(self, site: str, frame: str, descends: Iterable[str] = (), waiting: Waiting | None = None) -> Journal:
        """Become its writer, and make it where there is none; StoreError says why not.

        descends: ids of the stores that a new one is made from. waiting: what to do, again and again, while another
        server writes a journal that is shared; without it, that is an error.
        """
        self._require_one()
        if self.url:
            self.folder.mkdir(parents=True, exist_ok=True)
            words = (self.url, self.folder, site, frame, descends, waiting)
            journal: Journal = _postgres().journal.PostgresJournal(*words)
            return journal
        return self.open_file(site, frame, descends)

    def open_file(self, site: str, frame: str, descends: Iterable[str] = ()) -> SqliteJournal:
        """As `open`, of a file in the folder, which can be made to go on after an archive."""
        return SqliteJournal(self._file, site, frame, descends)

    def reader(self) -> JournalReader:
        """Read it; StoreError where that cannot be done."""
        return _postgres().reader.PostgresReader(self.url) if self.url else SqliteReader(self._file)

    def file_reader(self) -> SqliteReader:
        """As `reader`, of a file in the folder, which can be copied."""
        return SqliteReader(self._file)

    def store_id(self) -> str:
        """Id of the store; empty where there is none yet. StoreError where it cannot be read."""
        if not self.exists():
            return ""
        with self.reader() as reader:
            return reader.identity().id

    def epoch(self) -> int:
        """The epoch of the newest writer; StoreError where it cannot be read."""
        with self.reader() as reader:
            return reader.state().epoch

    def prepared_id(self, site: str, frame: str) -> str:
        """As `store_id`, before a server waits for its turn; one that is shared is made where there never was one.

        Servers that start at once on a new database know by its id that they have one journal.
        """
        if self.url:
            self._require_one()
            _postgres().journal.prepare(self.url, self.folder, site, frame)
        return self.store_id()

    def trusted_row(self, journal: JournalQueries) -> int:
        """What the folder has of rows up to this one is of the journal; see `Journal`. Before it is opened to write."""
        return int(_postgres().mark.trusted_row(self.folder, journal)) if self.url else journal.last_row

    def traces(self, *, in_use: bool) -> Traces:
        """What lies beside it and tells how far it once was. in_use: by a server, which has looked at its log."""
        if self.url:
            mark: Traces = _postgres().mark.traces_in(self.folder)
            return mark
        traces = look_beside(self._file)
        return replace(traces, log=LogScan()) if in_use else traces

    def _require_one(self) -> None:
        """ConfigError where the folder is another journal's: its snapshots are not true for this one."""
        if self.url and self._file.exists():
            raise ConfigError(self.folder, f"has a {JOURNAL_FILE} of its own; choose another --store for --journal")
        if not self.url and (self.folder / MARK_FILE).exists():
            problem = "is beside a journal in PostgreSQL; give its --journal, or choose another --store"
            raise ConfigError(self.folder, problem)

    @property
    def _file(self) -> Path:
        return self.folder / JOURNAL_FILE


def _postgres() -> Any:
    """The modules that need the extra `postgres`; ConfigError where it is not installed."""
    try:
        from mapserver.journal import postgres
        from mapserver.journal.postgres import connection, journal, mark, reader  # noqa: F401
    except ImportError as error:
        advice = "a journal in PostgreSQL needs psycopg: pip install '.[postgres]'"
        raise ConfigError("--journal", f"{advice} ({one_line(str(error))})") from None
    return postgres
