"""The archive: old journal rows, a Parquet file per hour of reception (docs/operation.md).

A file is written under a temporary name, synced, renamed and read back; then the journal forgets its rows. After a
crash a temporary file is removed, a complete one compared with the journal first.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields
from datetime import UTC, datetime
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from mapserver.journal.archive_file import KEY, NAME, ArchiveFile, ArchiveHeader, arrow, row_range, seal
from mapserver.journal.journal import JournalReader
from mapserver.journal.rows import ALL, LAST, JournalRow, JournalRows, Selection
from protocol.errors import StoreError
from protocol.files import sync_folder, whole_file
from protocol.machine.samples import COLUMNS, SAMPLE_DTYPE
from protocol.site.site_config import SiteConfig
from protocol.units import HOUR_NS

FOLDER = "archive"  # subfolder of a store
FILE_SAMPLES = 2_000_000  # approximate samples per file; a busier hour is split
GROUP_SAMPLES = 50_000  # approximate samples per row group; batches are never cut
TEMPORARY = "next.parquet.tmp"
READABLE = 0o640  # file mode: other programs read by the owner's group
ReceivedRow = tuple[JournalRow, int]  # with time of reception [ns]


class Archive:
    """The files of one store's archive, by rows. Thread-safe."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._opened: dict[Path, ArchiveFile] = {}

    def paths(self) -> list[Path]:
        """All files, sorted by row."""
        return sorted((p for p in self.folder.glob("*.parquet") if NAME.fullmatch(p.name)), key=row_range)

    def open(self, path: Path) -> ArchiveFile:
        """Open a file, or reuse it: files never change."""
        if path not in self._opened:
            self._opened[path] = ArchiveFile(path)
        return self._opened[path]

    def read_many(self, after: int, until: int, selection: Selection = ALL) -> Iterator[JournalRows]:
        """Rows after < row <= until, many at a time; StoreError for a missing file or a row in two files."""
        for path in self.cover(until, after):
            yield from self.open(path).read_many(after, until, selection)

    def cover(self, until: int, after: int = 0) -> Iterator[Path]:
        """Files with rows after < row <= until; StoreError as soon as one is missing, or a row is in two."""
        reached = after
        for path in self.paths():
            first, last = row_range(path)
            if last <= after or first > until:
                continue
            if first > reached + 1:
                break
            if after < first <= reached:
                raise StoreError(path, f"row {first} is also in another file; move one of them away")
            yield path
            reached = last
        if reached < until:
            problem = f"the file with row {reached + 1} is missing; restore it from a backup"
            raise StoreError(self.folder, problem)

    def next_stamp(self, from_ns: int) -> int | None:
        """The least stamp since from_ns in all files, or None."""
        stamps = (self.open(path).next_stamp(from_ns) for path in self.paths())
        return min((stamp for stamp in stamps if stamp is not None), default=None)


def archive(
    folder: Path,
    journal: JournalReader,
    site: SiteConfig,
    before_ns: int,
    forget: Callable[[int], int],
    now_ns: int = LAST,
) -> Iterator[Path]:
    """Move hours of reception that ended before `before_ns` into files, one per step, on any thread.

    forget: has the journal's owner call `Journal.forget` once, and returns its result. now_ns: the clock; rows received
    later count as received with the next valid one.
    """
    while path := next_file(folder, journal, site, before_ns, now_ns):
        _, last = row_range(path)
        while forget(last) < last:
            pass
        yield path


def next_file(
    folder: Path, journal: JournalReader, site: SiteConfig, before_ns: int, now_ns: int = LAST
) -> Path | None:
    """Write the next file, or take one left by a crash, whose rows the journal may forget; None if no hour is due."""
    for unfinished in (folder / TEMPORARY, *folder.glob(f".{TEMPORARY}.*")):  # of a killed process
        unfinished.unlink(missing_ok=True)
    archived = journal.archived_row
    left = [path for path in Archive(folder).paths() if row_range(path)[1] > archived]
    rows = _hour(_received(journal, archived, now_ns), before_ns)
    path = left[0] if left else write_file(folder, journal.identity().id, site, rows)
    if path:
        _compare(path, journal, archived)
    return path


def _received(journal: JournalReader, after: int, now_ns: int) -> Iterator[ReceivedRow]:
    """Rows and times of reception; later ones than now_ns take the next row's.

    A row received "next year" would block the archive until then.
    """
    until, known_ns = 0, 0
    for row in journal.read(after):
        if row.received_ns <= now_ns:
            yield row, row.received_ns
            continue
        if row.row > until:
            until, known_ns = _next_received(journal, row.row, now_ns)
        yield row, known_ns


def _next_received(journal: JournalReader, after: int, now_ns: int) -> tuple[int, int]:
    """The next row received by now, and when; LAST and now for none."""
    for rows in journal.read_many(after):
        if len(there := np.flatnonzero(rows.received_ns <= now_ns)):
            return int(rows.numbers[there[0]]), int(rows.received_ns[there[0]])
    return LAST, now_ns


def _hour(rows: Iterator[ReceivedRow], before_ns: int) -> Iterator[ReceivedRow]:
    """Rows of the first row's hour, if it ended before `before_ns`."""
    hour, samples = None, 0
    for row, received_ns in rows:
        hour = received_ns // HOUR_NS if hour is None else hour
        if received_ns // HOUR_NS != hour or (hour + 1) * HOUR_NS > before_ns or samples >= FILE_SAMPLES:
            return
        yield row, received_ns
        samples += len(row.rows)


def _compare(path: Path, journal: JournalReader, archived: int) -> None:
    """Require that a file equals, to the bit, the rows that the journal would forget."""
    _, last = row_range(path)
    for one, other in zip_longest(ArchiveFile(path).read(archived), journal.read(archived, last)):
        if one is None or other is None or _plain(one) != _plain(other):
            problem = f"row {(one or other).row} is not the journal's; if that is from a backup, move this file away"
            raise StoreError(path, problem)


def _plain(row: JournalRow) -> tuple[object, ...]:
    values = {field.name: getattr(row, field.name) for field in fields(row)}
    return tuple((values | {"rows": row.rows.tobytes()}).values())


def write_file(folder: Path, store: str, site: SiteConfig, rows: Iterator[ReceivedRow]) -> Path | None:
    """Write rows to a durable file; None without rows.

    Under a temporary name first, as its own contains the last row.
    """
    begin = next(rows, None)
    if begin is None:
        return None
    first, received_ns = begin
    temporary = folder / TEMPORARY
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(temporary, READABLE) as file:
            last_row = write_parquet(file, store, site, chain([first], (row for row, _ in rows)))
            seal(file)
        path = folder / file_name(received_ns, first.row, last_row)
        temporary.rename(path)
        sync_folder(folder)
    except OSError as error:
        raise StoreError(folder, f"cannot be written: {error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return path


def file_name(received_ns: int, first_row: int, last_row: int) -> str:
    """Hour of reception (UTC), first and last row."""
    hour = datetime.fromtimestamp(received_ns // HOUR_NS * 3600, UTC).strftime("%Y-%m-%dT%H")
    return f"{hour}_{first_row:06d}-{last_row:06d}.parquet"


def write_parquet(file: BinaryIO, store: str, site: SiteConfig, rows: Iterator[JournalRow]) -> int:
    """Write rows in row groups; returns the last number."""
    with ArchiveWriter(file, store, site) as writer:
        for group in _groups(rows):
            writer.add(JournalRows.joined(group))
    return group[-1].row


class ArchiveWriter:
    """Writes a file in row groups of about GROUP_SAMPLES; use it as a context, then `seal` the file.

    store, site: stated in the file.
    """

    def __init__(self, file: BinaryIO, store: str, site: SiteConfig) -> None:
        self._store, self._site = store, site
        self._machines: set[str] = set()
        self._waiting: list[Any] = []
        self._parquet = arrow("parquet").ParquetWriter(file, _schema(), **_options())

    def add(self, rows: JournalRows) -> None:
        """Write rows; batches are never cut."""
        self._machines |= {rows.machines[number] for number in np.unique(rows.machine).tolist()}
        self._waiting.append(_table(rows))
        if sum(table.num_rows for table in self._waiting) >= GROUP_SAMPLES:
            self._flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._flush()
            machines = tuple(sorted(self._machines))
            header = ArchiveHeader(self._store, self._site, self._site.frame, self._site.crs, machines)
            self._parquet.add_key_value_metadata({KEY: json.dumps(asdict(header))})
        self._parquet.close()

    def _flush(self) -> None:
        if self._waiting:
            self._parquet.write_table(arrow().concat_tables(self._waiting))
        self._waiting = []


def _options() -> dict[str, Any]:
    delta = dict.fromkeys(("seq", "row", "stamp_ns"), "DELTA_BINARY_PACKED")
    return {
        "compression": "zstd",
        "use_dictionary": ["machine", "spool_id", "received_ns"],
        # No dictionary for samples, which merges all NaN; split bytes also compress better.
        "column_encoding": dict.fromkeys(COLUMNS, "BYTE_STREAM_SPLIT") | delta,
        "write_page_checksum": True,
        "write_page_index": True,
    }


def _groups(rows: Iterator[JournalRow]) -> Iterator[list[JournalRow]]:
    group: list[JournalRow] = []
    samples = 0
    for row in rows:
        group.append(row)
        samples += len(row.rows)
        if samples >= GROUP_SAMPLES:
            yield group
            group, samples = [], 0
    if group:
        yield group


def _schema() -> Any:
    pa = arrow()
    types = {"machine": pa.string(), "spool_id": pa.uint64()}
    types |= dict.fromkeys(("seq", "row", "received_ns"), pa.int64())
    types |= {name: pa.from_numpy_dtype(SAMPLE_DTYPE[name]) for name in COLUMNS}
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in types.items()])


def _table(rows: JournalRows) -> Any:
    """One line per sample."""
    batch = np.repeat(np.arange(len(rows)), rows.lengths)
    firsts = np.cumsum(rows.lengths) - rows.lengths
    columns: dict[str, Any] = {
        "machine": np.array(rows.machines, object)[rows.machine[batch]],
        "spool_id": rows.spool_ids[batch],
        "seq": np.arange(len(batch)) + (rows.first_seqs - firsts)[batch],
        "row": rows.numbers[batch],
        "received_ns": rows.received_ns[batch],
    }
    columns |= {name: np.ascontiguousarray(rows.samples[name]) for name in COLUMNS}
    return arrow().table(columns, schema=_schema())
