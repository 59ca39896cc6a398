"""The mark in a server's folder: the journal's identity and known progress."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mapserver.journal.journal import JournalQueries
from mapserver.journal.postgres import MARK_FILE
from mapserver.journal.shortfall import ROW
from protocol.disk.high_water_mark import Traces, read_mark
from protocol.disk.write_ahead_log import LogScan
from protocol.errors import StoreError

# mark values besides the common ones: store id, epoch, checksum of the last row
STORE, EPOCH, CHECKSUM = "store", "epoch", "checksum"


def traces_in(folder: Path) -> Traces:
    """Traces of the journal in a server's folder; StoreError if unreadable."""
    return traces_of(_values_in(folder), folder / MARK_FILE)


def known_store(values: Mapping[str, int]) -> str:
    """Store id of a mark, or ""."""
    return f"{values[STORE]:016x}" if values.get(STORE) else ""


def store_in(folder: Path) -> str:
    """Store id of a folder, or ""; StoreError if unreadable."""
    return known_store(_values_in(folder))


def trusted_row(folder: Path, journal: JournalQueries) -> int:
    """See `Journal.trusted_row`."""
    return trusted_by(read_mark(folder / MARK_FILE), journal)


def trusted_by(values: Mapping[str, int], journal: JournalQueries) -> int:
    """As `trusted_row`, by a mark's values."""
    row = values.get(ROW, 0)
    is_there = known_store(values) == journal.identity().id and row <= journal.last_row
    is_same = is_there and (row <= journal.archived_row or journal.row_checksum(row) == values.get(CHECKSUM))
    return row if is_same else 0


def traces_of(values: Mapping[str, int], path: Path) -> Traces:
    """Values of a mark about losses."""
    mark = {name: n for name, n in values.items() if name not in (STORE, EPOCH, CHECKSUM)}
    return Traces(mark, LogScan(), path, b"")


def _values_in(folder: Path) -> dict[str, int]:
    try:
        return read_mark(folder / MARK_FILE)
    except OSError as error:
        raise StoreError(folder / MARK_FILE, f"cannot be read: {error.strerror}") from None
