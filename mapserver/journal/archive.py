"""The archive: journal rows that are old enough, in one Parquet file per hour of reception (docs/archive.md).

A file is made under a temporary name, synced, renamed, and read back; only then does the journal forget its rows. A
crash at any point leaves either a temporary file, which is removed, or a file whose rows the journal still has: it is
compared with them, and they are forgotten then.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from importlib import import_module
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from mapserver.journal.journal import LAST, JournalReader
from mapserver.journal.rows import ALL, JournalRow, Wanted
from protocol.arrays import AnyArray, Bools, Ints, Table
from protocol.config import from_table
from protocol.errors import ConfigError, StoreError
from protocol.machine.samples import COLUMNS, SAMPLE_DTYPE
from protocol.site.site_config import SiteConfig

FOLDER = "archive"  # in the folder of a store
SCHEMA = 1
HOUR_NS = 3_600_000_000_000
FILE_SAMPLES = 2_000_000  # about; an hour with more is cut into several files
GROUP_SAMPLES = 50_000  # of a row group, about: a batch is never cut
_NAME = re.compile(r"\d{4}-\d\d-\d\dT\d\d_(\d+)-(\d+)\.parquet")
_TEMPORARY = "next.parquet.tmp"
_KEY = b"sitegrid"  # of our own metadata
# Parquet's page checksums leave out the headers of pages and the footer, whose statistics decide what is skipped. So 12
# bytes before the footer, where readers of Parquet never look, hold the CRC-32 of all that is before them and of all
# that is behind them.
_SEAL = b"SGRD"
_SEAL_BYTES = 12


@dataclass(frozen=True)
class Header:
    """What a file says of itself beside Parquet's own metadata."""

    site: SiteConfig
    frame: str
    crs: str
    machines: tuple[str, ...]
    schema: int = SCHEMA


@dataclass(frozen=True)
class _Spans:
    """Rows, stamps and bounding boxes of row groups or of batches, each (n,)."""

    first_row: Ints
    last_row: Ints
    first_ns: Ints
    last_ns: Ints
    west_m: AnyArray
    south_m: AnyArray
    east_m: AnyArray
    north_m: AnyArray

    def may_hold(self, after: int, until: int, wanted: Wanted) -> Bools:
        """Which of them, (n,), may hold samples that are wanted; machines aside."""
        found = (self.last_row > after) & (self.first_row <= until)
        found &= (self.last_ns >= wanted.from_ns) & (self.first_ns <= wanted.to_ns)
        if place := wanted.bounds:
            found &= (self.west_m <= place.east_m) & (self.east_m >= place.west_m)
            found &= (self.south_m <= place.north_m) & (self.north_m >= place.south_m)
        return np.asarray(found, np.bool_)


class ArchiveFile:
    """One file of an archive. StoreError, with its name, where it is damaged or no file of an archive.

    first_row, last_row, samples, first_received_ns: of the whole file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        metadata = _arrow("parquet").read_metadata(_arrow().BufferReader(_tail(path)))
        self.header = _header(path, metadata.metadata)
        low, high = _statistics(metadata)
        self._groups = _spans(low, high)
        self.first_row, self.last_row = int(low["row"].min()), int(high["row"].max())
        self.first_received_ns = int(low["received_ns"].min())
        self.samples = int(metadata.num_rows)
        if _NAME.fullmatch(path.name) and row_range(path) != (self.first_row, self.last_row):
            raise StoreError(path, f"holds the rows {self.first_row} to {self.last_row}; give it back its name")

    def read(self, after: int = 0, until: int = LAST, wanted: Wanted = ALL) -> Iterator[JournalRow]:
        """Journal rows exactly as they were, in order; what is wanted as in `JournalReader.read`."""
        groups = np.flatnonzero(self._groups.may_hold(after, until, wanted)).tolist()
        if not groups or wanted.without.issuperset(self.header.machines):
            return
        file = _arrow("parquet").ParquetFile(_arrow().BufferReader(_checked(self.path)))
        for group in groups:
            yield from _batches(file.read_row_group(group), after, until, wanted)


class Archive:
    """The files of one store's archive, in the order of their rows. Any thread may read it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._opened: dict[Path, ArchiveFile] = {}

    def paths(self) -> list[Path]:
        """All files, by their names."""
        return sorted((p for p in self.folder.glob("*.parquet") if _NAME.fullmatch(p.name)), key=row_range)

    def open(self, path: Path) -> ArchiveFile:
        """Open a file, or take it from those that are open: files never change."""
        if path not in self._opened:
            self._opened[path] = ArchiveFile(path)
        return self._opened[path]

    def read(self, after: int, until: int, wanted: Wanted = ALL) -> Iterator[JournalRow]:
        """Rows after < row <= until; StoreError where a file is missing, or two hold the same row."""
        reached = after
        for path in self.paths():
            first, last = row_range(path)
            if last <= after or first > until:
                continue
            if first > reached + 1:
                break
            if after < first <= reached:
                raise StoreError(path, f"row {first} is also in another file; move one of them away")
            yield from self.open(path).read(after, until, wanted)
            reached = last
        if reached < until:
            problem = f"the file with row {reached + 1} is missing; restore it from a backup"
            raise StoreError(self.folder, problem)


def archive(
    folder: Path, journal: JournalReader, site: SiteConfig, before_ns: int, forget: Callable[[int], int]
) -> Iterator[Path]:
    """Move hours of reception that ended before `before_ns` from the journal into files, one for each that is taken.

    Runs on any thread with a reader of its own. forget: is handed a row and has the journal's owner call
    `Journal.forget` with it once, in between other work; returns what that returned.
    """
    while path := next_file(folder, journal, site, before_ns):
        _, last = row_range(path)
        while forget(last) < last:
            pass
        yield path


def next_file(folder: Path, journal: JournalReader, site: SiteConfig, before_ns: int) -> Path | None:
    """Make the next file, or find the one that a crash left; the journal, compared with it, may forget its rows.

    None where no further hour is old enough.
    """
    (folder / _TEMPORARY).unlink(missing_ok=True)
    archived = journal.archived_row
    left = [path for path in Archive(folder).paths() if row_range(path)[1] > archived]
    path = left[0] if left else _write(folder, site, _hour(journal.read(archived), before_ns))
    if path:
        _compare(path, journal, archived)
    return path


def row_range(path: Path) -> tuple[int, int]:
    """First and last journal row of a file, by its name."""
    first, last = path.stem.partition("_")[2].split("-")
    return int(first), int(last)


def _hour(rows: Iterator[JournalRow], before_ns: int) -> Iterator[JournalRow]:
    """Rows that were received in the same hour as the first one, if that ended before `before_ns`."""
    hour, samples = None, 0
    for row in rows:
        hour = row.received_ns // HOUR_NS if hour is None else hour
        if row.received_ns // HOUR_NS != hour or (hour + 1) * HOUR_NS > before_ns or samples >= FILE_SAMPLES:
            return
        yield row
        samples += len(row.rows)


def _write(folder: Path, site: SiteConfig, rows: Iterator[JournalRow]) -> Path | None:
    """Write rows to a new file that survives a power cut once it has its name; None where there are none."""
    first = next(rows, None)
    if first is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / _TEMPORARY
    try:
        with temporary.open("w+b") as file:
            last_row = _write_parquet(file, site, chain([first], rows))
            _seal(file)
            os.fsync(file.fileno())
        hour = datetime.fromtimestamp(first.received_ns // HOUR_NS * 3600, UTC).strftime("%Y-%m-%dT%H")
        path = folder / f"{hour}_{first.row:06d}-{last_row:06d}.parquet"
        temporary.rename(path)
        _sync_folder(folder)
    except OSError as error:
        raise StoreError(folder, f"cannot be written: {error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _write_parquet(file: Any, site: SiteConfig, rows: Iterator[JournalRow]) -> int:
    """Write rows, row group by row group; returns the last one's number."""
    delta = dict.fromkeys(("seq", "row", "stamp_ns"), "DELTA_BINARY_PACKED")
    options = {
        "compression": "zstd",
        "use_dictionary": ["machine", "spool_id", "received_ns"],
        # Never a dictionary for samples: it would take every NaN for the same. Split by byte they also shrink better.
        "column_encoding": dict.fromkeys(COLUMNS, "BYTE_STREAM_SPLIT") | delta,
        "write_page_checksum": True,
        "write_page_index": True,
    }
    machines: set[str] = set()
    with _arrow("parquet").ParquetWriter(file, _schema(), **options) as writer:
        for group in _groups(rows):
            writer.write_table(_table(group))
            machines |= {row.machine for row in group}
        header = Header(site, site.frame, site.crs, tuple(sorted(machines)))
        writer.add_key_value_metadata({_KEY: json.dumps(asdict(header))})
    return group[-1].row


def _groups(rows: Iterator[JournalRow]) -> Iterator[list[JournalRow]]:
    """Batches of one row group each."""
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
    pa = _arrow()
    types = {"machine": pa.string(), "spool_id": pa.uint64()}
    types |= dict.fromkeys(("seq", "row", "received_ns"), pa.int64())
    types |= {name: pa.from_numpy_dtype(SAMPLE_DTYPE[name]) for name in COLUMNS}
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in types.items()])


def _table(group: list[JournalRow]) -> Any:
    """One line per sample."""
    samples = np.concatenate([row.rows for row in group])
    lengths = [len(row.rows) for row in group]
    batch = np.repeat(np.arange(len(group)), lengths)
    columns: dict[str, Any] = {
        "machine": np.array([row.machine for row in group], object)[batch],
        "spool_id": np.array([row.spool_id for row in group], np.uint64)[batch],
        "seq": np.concatenate([row.first_seq + np.arange(len(row.rows)) for row in group]),
        "row": np.array([row.row for row in group], np.int64)[batch],
        "received_ns": np.array([row.received_ns for row in group], np.int64)[batch],
    }
    columns |= {name: np.ascontiguousarray(samples[name]) for name in COLUMNS}
    return _arrow().table(columns, schema=_schema())


def _batches(table: Any, after: int, until: int, wanted: Wanted) -> Iterator[JournalRow]:
    """The batches of a row group that are wanted."""
    names = set(table.column_names)
    samples: Table = np.zeros(table.num_rows, SAMPLE_DTYPE)
    for name in COLUMNS:
        samples[name] = table.column(name).to_numpy() if name in names else np.nan  # where it was added later
    numbers = table.column("row").to_numpy()
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    ends = np.append(starts[1:], len(samples))
    ranged = {"row": numbers, **{name: samples[name] for name in ("stamp_ns", "x_m", "y_m")}}
    low, high = ({name: f.reduceat(of, starts) for name, of in ranged.items()} for f in (np.minimum, np.maximum))
    batches = table.select(["row", "machine", "spool_id", "seq", "received_ns"]).take(starts).to_pylist()
    for i in np.flatnonzero(_spans(low, high).may_hold(after, until, wanted)).tolist():
        row, machine, spool_id, seq, received_ns = batches[i].values()
        if machine not in wanted.without:
            yield JournalRow(row, machine, spool_id, seq, samples[starts[i] : ends[i]], received_ns)


def _statistics(metadata: Any) -> tuple[dict[str, AnyArray], dict[str, AnyArray]]:
    """Smallest and largest values of the columns of each row group, each (groups,)."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    columns = [{c["path_in_schema"]: c["statistics"] for c in group.to_dict()["columns"]} for group in groups]
    names = ("row", "received_ns", "stamp_ns", "x_m", "y_m")
    low, high = ({name: np.array([c[name][end] for c in columns]) for name in names} for end in ("min", "max"))
    return low, high


def _spans(low: dict[str, AnyArray], high: dict[str, AnyArray]) -> _Spans:
    rows, stamps = ((low[name], high[name]) for name in ("row", "stamp_ns"))
    return _Spans(*rows, *stamps, low["x_m"], low["y_m"], high["x_m"], high["y_m"])


def _seal(file: Any) -> None:
    """Move the footer of a new file behind its seal."""
    file.seek(0)
    data = file.read()
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    body, footer = data[:start], data[start:]
    file.seek(start)
    file.write(_SEAL + zlib.crc32(body).to_bytes(4, "little") + zlib.crc32(footer).to_bytes(4, "little") + footer)
    file.flush()


def _tail(path: Path) -> bytes:
    """Seal and footer, checked, without reading the rest."""
    length = int.from_bytes(_read(path, 8)[:4], "little")  # of the footer alone
    tail = _read(path, _SEAL_BYTES + length + 8)
    if tail[-4:] != b"PAR1" or tail[:4] != _SEAL:
        raise StoreError(path, "is damaged, or no file of a map server's archive; restore it from a backup")
    if zlib.crc32(tail[_SEAL_BYTES:]) != int.from_bytes(tail[8:_SEAL_BYTES], "little"):
        raise StoreError(path, "is damaged; restore it from a backup")
    return tail


def _checked(path: Path) -> bytes:
    """All bytes of a file, read once, so that what is decoded is what was checked."""
    tail = _tail(path)
    data = _read(path)
    body = len(data) - len(tail)
    if data[body:] != tail or zlib.crc32(data[:body]) != int.from_bytes(tail[4:8], "little"):
        raise StoreError(path, "is damaged; restore it from a backup")
    return data


def _read(path: Path, last: int | None = None) -> bytes:
    """The bytes of a file, or so many of its last ones."""
    try:
        with path.open("rb") as file:
            if last is not None:
                file.seek(max(0, file.seek(0, os.SEEK_END) - last))
            return file.read()
    except OSError as error:
        raise StoreError(path, f"cannot be read: {error.strerror}") from None


def _header(path: Path, metadata: dict[bytes, bytes]) -> Header:
    table = json.loads(metadata[_KEY])
    if table["schema"] != SCHEMA:
        raise StoreError(path, f"has schema {table['schema']}, known is {SCHEMA}; use the version that wrote it")
    return from_table(Header, table, str(path))


def _compare(path: Path, journal: JournalReader, archived: int) -> None:
    """Make sure that a file holds, to the bit, the rows that the journal would forget."""
    _, last = row_range(path)
    for one, other in zip_longest(ArchiveFile(path).read(archived), journal.read(archived, last)):
        if one is None or other is None or _plain(one) != _plain(other):
            problem = f"row {(one or other).row} is not the journal's; if that is from a backup, move this file away"
            raise StoreError(path, problem)


def _plain(row: JournalRow) -> tuple[object, ...]:
    values = {field.name: getattr(row, field.name) for field in fields(row)}
    return tuple((values | {"rows": row.rows.tobytes()}).values())


def _sync_folder(folder: Path) -> None:
    """Make a new name durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _arrow(module: str = "") -> Any:
    """Import pyarrow, or a module of it, where it is first needed: a server without an archive does without."""
    try:
        return import_module(f"pyarrow.{module}" if module else "pyarrow")
    except ModuleNotFoundError:
        raise ConfigError("archive", "pyarrow is not installed: pip install 'sitegrid[archive]'") from None
