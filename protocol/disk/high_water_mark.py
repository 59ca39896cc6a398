"""A high-water mark beside a database: committed numbers, compared at the next opening.

NAME-mark is a chain of records: the numbers that a commit changed, and a checksum continuing the last record's. Reading
stops at the first unsound record; a name's newest value counts.

A record follows its commit and is not synced: a mark never claims too much, and one left behind or torn by a power cut
raises no alarm. For one write and no sync it covers every commit before a kill, or some seconds before a power cut.
`Traces` are a database's write-ahead log and mark.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgpack

from protocol.disk.write_ahead_log import FRAME_HEADER, HEADER, LogScan, scan
from protocol.errors import StoreError
from protocol.files import PRIVATE, whole_file, write_whole

_RECORD = struct.Struct("<II")  # length and checksum before the values
LIMIT = 2**20  # bytes beyond which the newest values are written anew
_OFTEN = 400  # bytes per value, ten times its need


def mark_path(database: Path) -> Path:
    """Path of a database's mark."""
    return database.with_name(f"{database.name}-mark")


def read_mark(path: Path) -> dict[str, int]:
    """Newest value by name, none without a sound mark; OSError."""
    return _read(path)[0]


class HighWaterMark:
    """A writer's mark. values: the newest. OSError only if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.values, self._end, self._crc = _read(path)
        self._unwritten: dict[str, int] = {}
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE)

    def write(self, values: Mapping[str, int]) -> None:
        """Note a commit; a full disk delays the mark."""
        self.values.update(values)
        self._unwritten.update(values)
        with contextlib.suppress(OSError):
            if self._end > max(LIMIT, _OFTEN * len(self.values)):
                self._write_anew()
            else:
                self._append()

    def replace(self, values: Mapping[str, int]) -> None:
        """Note exactly these values, after comparison; OSError."""
        if values != self.values:
            self.values = dict(values)
            self._write_anew()

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1  # another file may get its number

    def _append(self) -> None:
        record, crc = _record(self._unwritten, self._crc)
        if os.pwrite(self._file, record, self._end) == len(record):  # else the next one replaces it
            self._end, self._crc = self._end + len(record), crc
            self._unwritten.clear()

    def _write_anew(self) -> None:
        record, crc = _record(self.values, 0)
        with whole_file(self.path, PRIVATE) as file:
            file.write(record)
        os.close(self._file)
        self._file = os.open(self.path, os.O_RDWR)
        self._end, self._crc = len(record), crc
        self._unwritten.clear()


def _record(values: Mapping[str, int], crc: int) -> tuple[bytes, int]:
    body: bytes = msgpack.packb(dict(values))
    crc = zlib.crc32(body, crc)
    return _RECORD.pack(len(body), crc) + body, crc


def _read(path: Path) -> tuple[dict[str, int], int, int]:
    values: dict[str, int] = {}
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return values, 0, 0
    at = crc = 0
    while at + _RECORD.size <= len(data):
        length, expected = _RECORD.unpack_from(data, at)
        end = at + _RECORD.size + length
        body = data[at + _RECORD.size : end]
        if length == 0 or len(body) < length or zlib.crc32(body, crc) != expected:
            break
        values.update(msgpack.unpackb(body))
        at, crc = end, expected
    return values, at, crc


@dataclass(frozen=True)
class Traces:
    """Traces beside a closed database. mark: see `HighWaterMark`; log: its write-ahead log.

    cut_short: bytes of a log that SQLite will not fully use and soon overwrites, else empty.
    """

    mark: dict[str, int]
    log: LogScan
    log_path: Path
    cut_short: bytes

    @property
    def damage(self) -> str:
        """Damage of the log, or ""."""
        if self.log.damaged_at is None:
            return ""
        dropped = self.log.frames - self.log.recovered
        return f"{self.log_path.name} is damaged at byte {self.log.damaged_at}: its last {dropped} pages cannot be used"

    def keep_log(self, number: int) -> None:
        """Copy a log that was cut short, for a person; OSError."""
        if self.cut_short:
            write_whole(self.log_path.with_name(f"{self.log_path.name}.damaged-{number}"), self.cut_short, PRIVATE)


def look_beside(database: Path) -> Traces:
    """Read traces before SQLite opens a database and drops what it cannot use; StoreError."""
    log_path = database.with_name(f"{database.name}-wal")
    try:
        log = log_path.read_bytes() if log_path.exists() else b""
        mark = read_mark(mark_path(database))
    except OSError as error:
        raise StoreError(database, f"cannot be read: {error}") from None
    held = scan(log)
    has_frames = len(log) > HEADER + FRAME_HEADER
    is_cut_short = has_frames and (held.recovered < held.frames or not held.recovered)
    return Traces(mark, held, log_path, log if is_cut_short else b"")
