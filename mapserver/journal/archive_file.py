"""An archive file: columns, metadata, a seal that reveals damage, and reading.

Parquet's checksums omit page headers and the footer, whose statistics decide what is skipped. Hence 12 bytes before the
footer, ignored by Parquet readers, with CRC-32 of all before and after. Seals can be forged, so samples are checked
like a machine's.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mapserver.journal.places import FilePlace
from mapserver.journal.rows import ALL, LAST, JournalRow, JournalRows, Selection
from protocol.arrays import AnyArray, Bools, Ints, Table
from protocol.config import from_table
from protocol.errors import ConfigError, MessageError, StoreError
from protocol.machine.samples import COLUMNS, SAMPLE_DTYPE, check_samples
from protocol.site.site_config import MAX_EXTENT_M, SiteConfig
from protocol.site.site_config import NAME as MACHINE_NAME
from protocol.wire.codec import MAX_SEQ

SCHEMA = 6
KEY = b"sitegrid"  # key of our metadata
NAME = re.compile(r"\d{4}-\d\d-\d\dT\d\d_(\d+)-(\d+)\.parquet")
_IDENTITY = ["machine", "row", "spool_id", "seq", "received_ns"]  # columns besides samples
_RANGED = ("row", "received_ns", "stamp_ns", "x_m", "y_m")  # columns with ranges in Parquet's statistics
MAX_GROUP = 2**20  # samples per row group; small files can claim any number
_SEAL = b"SGRD"
_SEAL_BYTES = 12


@dataclass(frozen=True)
class ArchiveHeader:
    """What a file states about itself. store: id of its store."""

    store: str
    site: SiteConfig
    frame: str
    crs: str
    machines: tuple[str, ...]
    schema: int = SCHEMA


@dataclass(frozen=True)
class _Spans:
    """Rows, stamps and bounding boxes of row groups or batches, (n,) each."""

    first_row: Ints
    last_row: Ints
    first_ns: Ints
    last_ns: Ints
    west_m: AnyArray
    south_m: AnyArray
    east_m: AnyArray
    north_m: AnyArray

    def may_hold(self, after: int, until: int, selection: Selection) -> Bools:
        """Which (n,) may hold selected samples, whatever the machine."""
        overlaps = (self.last_row > after) & (self.first_row <= until)
        overlaps &= (self.last_ns >= selection.from_ns) & (self.first_ns <= selection.to_ns)
        if place := selection.bounds:
            overlaps &= (self.west_m <= place.east_m) & (self.east_m >= place.west_m)
            overlaps &= (self.south_m <= place.north_m) & (self.north_m >= place.south_m)
        return np.asarray(overlaps, np.bool_)


class ArchiveFile:
    """An archive file; StoreError if damaged or foreign.

    first_row, last_row, samples, first_received_ns: of the file. identity: hex digits unique to its content.
    """

    def __init__(self, path: Path | FilePlace) -> None:
        self.path = path
        tail = _tail(path)
        self.identity = tail[len(_SEAL) : _SEAL_BYTES].hex()
        with _described(path):
            metadata = arrow("parquet").read_metadata(arrow().BufferReader(tail))
            self.header = _header(path, metadata.metadata)
            _check_schema(metadata)
            self._low, self._high = low, high = _statistics(metadata)
        self._groups = _spans(low, high)
        self.first_row, self.last_row = int(low["row"].min()), int(high["row"].max())
        self.first_received_ns = int(low["received_ns"].min())
        self.samples = int(metadata.num_rows)
        if NAME.fullmatch(path.name) and row_range(path) != (self.first_row, self.last_row):
            raise StoreError(path, f"holds the rows {self.first_row} to {self.last_row}; give it back its name")

    def read(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRow]:
        """Rows as journalled, in order; see `JournalReader.read`."""
        return chain.from_iterable(self.read_many(after, until, selection))

    def read_many(
        self, after: int = 0, until: int = LAST, selection: Selection = ALL, columns: Sequence[str] = COLUMNS
    ) -> Iterator[JournalRows]:
        """As `read`, many at a time. columns: of samples, with `stamp_ns`, `x_m` and `y_m`; others are zero."""
        groups = np.flatnonzero(self._groups.may_hold(after, until, selection)).tolist()
        if not groups or selection.without.issuperset(self.header.machines):
            return
        with _described(self.path):
            file = arrow("parquet").ParquetFile(arrow().BufferReader(_checked(self.path)))
        for group in groups:
            with _described(self.path):
                table = file.read_row_group(group, [*_IDENTITY, *columns])
                self._check(group, {name: table.column(name).to_numpy() for name in table.column_names[1:]}, table)
            if len(rows := _rows(table, columns, after, until, selection)):
                yield rows

    def _check(self, group: int, columns: Mapping[str, AnyArray], table: Any) -> None:
        """ValueError unless a row group holds consecutive batches of plausible samples in the stated ranges."""
        check_samples({name: values for name, values in columns.items() if name in COLUMNS}, MAX_EXTENT_M)
        for name in _RANGED:
            if (columns[name].min(), columns[name].max()) != (self._low[name][group], self._high[name][group]):
                raise ValueError(f"{name} is not in the range that is stated")
        names = table.column("machine").combine_chunks().dictionary_encode()
        if unknown := set(names.dictionary.to_pylist()) - set(self.header.machines):
            raise ValueError(f"machine {min(unknown)[:70]!r} is not among those that are stated")
        ahead = np.diff(columns["row"])
        if ahead.min(initial=0) < 0 or not 1 <= columns["seq"].min() <= columns["seq"].max() <= MAX_SEQ:
            raise ValueError("rows or sequence numbers are not in order")
        inside = ahead == 0  # sample pairs within a batch
        same = (columns["spool_id"], columns["received_ns"], names.indices.to_numpy())
        if (
            any((values[1:] != values[:-1])[inside].any() for values in same)
            or (np.diff(columns["seq"])[inside] != 1).any()
        ):
            raise ValueError("a row is no batch of one machine")

    def next_stamp(self, from_ns: int) -> int | None:
        """The least stamp since from_ns, or None. Reads only row groups that span it."""
        first_ns = self._groups.first_ns
        stamps = first_ns[first_ns >= from_ns].tolist()
        for rows in self.read_many(selection=Selection(from_ns=from_ns, to_ns=min(stamps, default=LAST) - 1)):
            some = rows.samples["stamp_ns"]
            stamps.append(int(some[some >= from_ns].min()))
        return min(stamps, default=None)


def row_range(path: Path | FilePlace) -> tuple[int, int]:
    """First and last row in a file's name."""
    first, last = path.stem.partition("_")[2].split("-")
    return int(first), int(last)


def _rows(table: Any, of_samples: Sequence[str], after: int, until: int, selection: Selection) -> JournalRows:
    """Selected rows of a row group."""
    samples: Table = np.zeros(table.num_rows, SAMPLE_DTYPE)
    for name in of_samples:
        samples[name] = table.column(name).to_numpy()
    numbers = table.column("row").to_numpy()
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    ranged = {"row": numbers, **{name: samples[name] for name in ("stamp_ns", "x_m", "y_m")}}
    low, high = (
        {name: f.reduceat(values, starts) for name, values in ranged.items()} for f in (np.minimum, np.maximum)
    )
    heads = table.select(_IDENTITY).take(starts)
    names = heads.column("machine").combine_chunks().dictionary_encode()
    columns = (heads.column(name).to_numpy() for name in ("row", "spool_id", "seq", "received_ns"))
    machines, machine = tuple(names.dictionary.to_pylist()), names.indices.to_numpy().astype(np.int64)
    rows = JournalRows(samples, np.diff(starts, append=len(samples)), machines, machine, *columns)
    return rows.chosen(_spans(low, high).may_hold(after, until, selection)).without(selection.without)


def _statistics(metadata: Any) -> tuple[dict[str, AnyArray], dict[str, AnyArray]]:
    """Minima and maxima of columns, (groups,) each."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    if not groups or any(not 0 < group.num_rows <= MAX_GROUP for group in groups):
        raise ValueError("it has no samples, or too many at once")
    columns = [{c["path_in_schema"]: c["statistics"] for c in group.to_dict()["columns"]} for group in groups]
    low, high = ({name: np.array([c[name][end] for c in columns]) for name in _RANGED} for end in ("min", "max"))
    if (low["row"][1:] <= high["row"][:-1]).any():
        raise ValueError("row groups are not in the order of their rows")
    return low, high


def _spans(low: dict[str, AnyArray], high: dict[str, AnyArray]) -> _Spans:
    rows, stamps = ((low[name], high[name]) for name in ("row", "stamp_ns"))
    return _Spans(*rows, *stamps, low["x_m"], low["y_m"], high["x_m"], high["y_m"])


def seal(file: BinaryIO) -> None:
    """Insert the seal before a new file's footer."""
    file.seek(0)
    data = file.read()
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    body, footer = data[:start], data[start:]
    file.seek(start)
    file.write(_SEAL + zlib.crc32(body).to_bytes(4, "little") + zlib.crc32(footer).to_bytes(4, "little") + footer)
    file.flush()


def _tail(path: Path | FilePlace) -> bytes:
    """Checked seal and footer, without the rest."""
    length = int.from_bytes(_read(path, 8)[:4], "little")  # of the footer
    tail = _read(path, _SEAL_BYTES + length + 8)
    if tail[-4:] != b"PAR1" or tail[:4] != _SEAL:
        raise StoreError(path, "is damaged, or no file of a map server's archive; restore it from a backup")
    if zlib.crc32(tail[_SEAL_BYTES:]) != int.from_bytes(tail[8:_SEAL_BYTES], "little"):
        raise StoreError(path, "is damaged; restore it from a backup")
    return tail


def _checked(path: Path | FilePlace) -> bytes:
    """A whole file, read once, so that what is decoded is what was checked."""
    tail = _tail(path)
    data = _read(path)
    body = len(data) - len(tail)
    if data[body:] != tail or zlib.crc32(data[:body]) != int.from_bytes(tail[4:8], "little"):
        raise StoreError(path, "is damaged; restore it from a backup")
    return data


@contextmanager
def _described(path: Path | FilePlace) -> Iterator[None]:
    """Turn any error of Parquet or of foreign values into a StoreError."""
    wrong = (arrow().ArrowException, OSError, ValueError, TypeError, LookupError, MessageError)
    try:
        yield
    except wrong as error:
        problem = f"is no file that a map server wrote ({type(error).__name__}: {error}); leave it out"
        raise StoreError(path, problem) from None


def _check_schema(metadata: Any) -> None:
    """ValueError unless columns and types are an archive's."""
    kinds = {"machine": "string", "spool_id": "uint64"} | dict.fromkeys(("seq", "row", "received_ns"), "int64")
    kinds |= {name: str(arrow().from_numpy_dtype(SAMPLE_DTYPE[name])) for name in COLUMNS}
    schema = metadata.schema.to_arrow_schema()
    if stated := [f"{f.name}: {f.type}" for f in schema if f.nullable or kinds.get(f.name) != str(f.type)]:
        raise ValueError(f"column {stated[0]} is none of an archive")
    if missing := kinds.keys() - set(schema.names):
        raise ValueError(f"column {min(missing)} is missing")


def _read(path: Path | FilePlace, last: int | None = None) -> bytes:
    """A file's bytes, or its last ones."""
    if isinstance(path, Path) and path.exists() and not path.is_file():
        raise StoreError(path, "is no regular file")  # a FIFO would block
    try:
        with path.open("rb") as file:
            if last is not None:
                file.seek(max(0, file.seek(0, os.SEEK_END) - last))
            return file.read()
    except OSError as error:
        raise StoreError(path, f"cannot be read: {error.strerror or error}") from None


def _header(path: Path | FilePlace, metadata: dict[bytes, bytes]) -> ArchiveHeader:
    table = json.loads((metadata or {})[KEY])
    if table["schema"] != SCHEMA:
        problem = f"has schema {table['schema']}, this version knows {SCHEMA}"
        raise StoreError(path, f"{problem}; read it with the version that wrote it")
    header = from_table(ArchiveHeader, table, str(path))
    if other := [name for name in header.machines if not MACHINE_NAME.fullmatch(name)]:
        raise ValueError(f"{other[0][:70]!r} is not a name")
    return header


def arrow(module: str = "") -> Any:
    """Import pyarrow, or a module of it, when needed."""
    try:
        return import_module(f"pyarrow.{module}" if module else "pyarrow")
    except ModuleNotFoundError:
        raise ConfigError("archive", "pyarrow is not installed: pip install '.[archive]'") from None
