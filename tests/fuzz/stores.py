"""What the server keeps: a journal row's payload and a file of the archive. Damage is named, never served as data."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np

from mapserver.journal.archive import FOLDER, next_file
from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.journal import Journal
from mapserver.journal.reader import JournalReader
from mapserver.journal.rows import Admission, JournalRow
from protocol.errors import StoreError
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import SampleBatch
from tests.fuzz.messages import messages
from tests.fuzz.mutations import files
from tests.fuzz.verdict import Decoder
from tests.golden.make import T0, rows

SITE = SiteConfig("paper", 49.0, 8.0)
HOUR_NS = 3_600_000_000_000


def journal_decoder(folder: Path) -> Decoder:
    """A row whose payload is another one, its checksum left as it was."""
    expected = _journal(folder)
    path = folder / "journal.db"
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA synchronous=OFF")
    payload = db.execute("SELECT payload FROM journal WHERE row = 2").fetchone()[0]

    def decode(data: bytes) -> None:
        db.execute("UPDATE journal SET payload = ? WHERE row = 2", (data,))
        with JournalReader(path) as reader:
            _compare(list(reader.read()), expected)

    return Decoder("journal", (payload,), decode, (StoreError,), messages, "row 2 is damaged")


def archive_decoder(folder: Path) -> Decoder:
    """A file that is damaged anywhere."""
    expected = _journal(folder)
    with JournalReader(folder / "journal.db") as reader:
        made = next_file(folder / FOLDER, reader, SITE, T0 + 100 * HOUR_NS)
    assert made is not None

    def decode(data: bytes) -> None:
        made.write_bytes(data)
        _compare(list(ArchiveFile(made).read()), expected)

    return Decoder("archive", (made.read_bytes(),), decode, (StoreError,), files, made.name)


def _journal(folder: Path) -> list[JournalRow]:
    """Make a journal of three rows; returns what has to be read from it."""
    journal = Journal(folder / "journal.db", SITE.name, SITE.frame)
    journal.begin()
    for i in range(3):
        batch = SampleBatch("loader-1", 7, 1 + 3 * i, rows(), SITE.frame)
        journal.append(Admission(batch, 0, 0), T0)
    journal.commit()
    rows_read = list(journal.read())
    journal.close()
    return rows_read


def _compare(rows_read: list[JournalRow], expected: list[JournalRow]) -> None:
    assert [row.row for row in rows_read] == [row.row for row in expected]
    for one, other in zip(rows_read, expected, strict=True):
        assert np.array_equal(one.rows.tobytes(), other.rows.tobytes())
        assert (one.machine, one.spool_id, one.first_seq) == (other.machine, other.spool_id, other.first_seq)
