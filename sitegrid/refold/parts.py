"""Parts of archives, as one task reads each: a Parquet file, or a stretch of a journal that is not archived yet.

They are values that other processes understand, and other hosts where their place is one that these reach, too.
"""

from __future__ import annotations

import socket
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.history import History, read_history
from mapserver.journal.journal import JournalReader
from mapserver.journal.location import JournalLocation
from mapserver.journal.places import Place
from mapserver.journal.rows import JournalRows
from protocol.errors import StoreError
from protocol.machine.samples import COLUMNS
from protocol.site.site_config import SiteConfig

SLICE_ROWS = 20_000  # of a journal: up to two million samples, as in a file
HEADS = ("stamp_ns", "x_m", "y_m")  # of samples: all that is needed to choose among them


@dataclass(frozen=True)
class Origin:
    """What a part says of itself. identity: hex digits that other contents do not have. site: where it is known."""

    identity: str
    name: str
    frame: str
    machines: tuple[str, ...]
    stores: tuple[str, ...]
    site: SiteConfig | None


@dataclass(frozen=True)
class FilePart:
    """One file of an archive."""

    path: Path | Place

    def origin(self) -> Origin:
        """What its header says."""
        file = ArchiveFile(self.path)
        header = file.header
        identity = f"{file.identity}-{header.store}-{file.first_row}-{file.samples}"
        return Origin(identity, header.site.name, header.frame, header.machines, (header.store,), header.site)

    def read(self, columns: Sequence[str] = COLUMNS) -> Iterator[JournalRows]:
        """Its rows, with these columns of their samples at least; StoreError where it is damaged."""
        return ArchiveFile(self.path).read_many(columns=columns)

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class JournalPart:
    """Rows after < row <= until of a store's journal; those that are archived meanwhile are read from its archive.

    host: that alone can read it, empty where all can: SQLite's files are no good to others while a server writes.
    """

    location: JournalLocation
    after: int
    until: int
    host: str

    def origin(self) -> Origin:
        """What the journal says; its rows are read for their checksum."""
        with self._reader() as journal:
            store = journal.identity()
            crc32 = 0
            for rows in read_history(History(journal, self.location.archive), self.after, self.until):
                crc32 = zlib.crc32(rows.samples.tobytes(), crc32)
            machines = tuple(sorted({machine for machine, _ in journal.watermarks()}))
            identity = f"{crc32:08x}-{store.id}-{self.after}-{self.until}"
            return Origin(identity, journal.site, journal.frame, machines, (store.id,), None)

    def read(self, columns: Sequence[str] = COLUMNS) -> Iterator[JournalRows]:  # noqa: ARG002 # rows are whole records
        """Its rows; StoreError where they are damaged."""
        with self._reader() as journal:
            yield from read_history(History(journal, self.location.archive), self.after, self.until)

    def __str__(self) -> str:
        return f"{self.location}, rows {self.after + 1} to {self.until}"

    def _reader(self) -> JournalReader:
        if self.host and (here := socket.gethostname()) != self.host:
            advice = "fold its archive alone, or fold on that host with --jobs"
            raise StoreError(
                self.location, f"is a journal that {self.host} alone can read, and a worker runs on {here}; {advice}"
            )
        return self.location.reader()


Part = FilePart | JournalPart
