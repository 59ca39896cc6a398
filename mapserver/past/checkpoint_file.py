"""One checkpoint on disk: the evidence of samples stamped before a time, by separately readable blocks.

    MAGIC | records of blocks | index, one INDEX per block, sorted | header, JSON | TAIL

The tail has lengths of index and header and their CRC-32, the index one of each block, so reading a few blocks checks
them and needs no others. Files never change.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from mapserver.evidence.grid_state import GridState
from mapserver.evidence.pages import Record, is_sound
from protocol.arrays import Ints, Table
from protocol.errors import StoreError
from protocol.files import PRIVATE, whole_file
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.geometry import BLOCK_CELLS, CellWindow

MAGIC = b"SGCHECK2"
OPEN_END_NS = MAX_STAMP_NS + 1  # closing time of a snapshot: all samples of its rows
INDEX = np.dtype([("x", "<i4"), ("y", "<i4"), ("first", "<i8"), ("bytes", "<i4"), ("crc32", "<u4")])
TAIL = struct.Struct("<QII8s")  # blocks, bytes of the header, CRC-32 of index and header, MAGIC
READ_BYTES = 2**22  # most bytes of consecutive blocks per read

FileState = tuple[int, int, int]


def file_state(stat: os.stat_result) -> FileState:
    """Inode, change time and size, which identify a file's version."""
    return stat.st_ino, stat.st_mtime_ns, stat.st_size


@dataclass(frozen=True)
class Header:
    """Validity of a checkpoint.

    closed_ns: it has samples stamped earlier, from journal rows up to `row`; OPEN_END_NS: all. facts: its other
    dependencies. The rest: as in GridState.
    """

    closed_ns: int
    row: int
    facts: Mapping[str, Any]
    folded: int = 0
    skipped: int = 0
    newest_ns: int = 0
    oldest_ns: int = 0

    def with_totals(self, state: GridState) -> Header:
        """The header with the totals of a grid's state."""
        return replace(self, **{field.name: getattr(state, field.name) for field in fields(GridState)[1:]})

    @property
    def state(self) -> GridState:
        """The grid's state without blocks."""
        return GridState((), self.folded, self.skipped, self.newest_ns, self.oldest_ns)


class DamagedError(StoreError):
    """A file is no checkpoint, or damaged."""


class Checkpoint:
    """An open checkpoint. All methods raise DamagedError if it is unusable, OSError if unreadable.

    index (blocks,): INDEX. state: of the opened file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb", buffering=0)
        try:
            stat = os.fstat(self._file.fileno())
            self.state = file_state(stat)
            self.header, self.index = self._read_end(stat.st_size)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def numbers_in(self, window: CellWindow | None) -> Ints:
        """Sorted numbers of the blocks in a window; None for all."""
        if window is None:
            return np.arange(len(self.index))
        n, x, y = BLOCK_CELLS, self.index["x"], self.index["y"]
        inside = (x >= window.column // n) & (x <= (window.column + window.columns - 1) // n)
        inside &= (y >= window.row // n) & (y <= (window.row + window.rows - 1) // n)
        return np.flatnonzero(inside)

    def records(self, numbers: Ints) -> Iterator[memoryview]:
        """Checked bytes of blocks, sorted; neighbours are read together."""
        at = 0
        firsts, sizes, crcs = (self.index[name][numbers].tolist() for name in ("first", "bytes", "crc32"))
        while at < len(numbers):
            end = at + 1
            while end < len(numbers) and firsts[end] == firsts[end - 1] + sizes[end - 1] < firsts[at] + READ_BYTES:
                end += 1
            data = self._read(firsts[at], firsts[end - 1] + sizes[end - 1] - firsts[at])
            for i in range(at, end):
                start = firsts[i] - firsts[at]
                record = data[start : start + sizes[i]]
                if zlib.crc32(record) != crcs[i]:
                    raise self._damaged("a block")
                yield record
            at = end

    def blocks(self, numbers: Ints) -> Iterator[tuple[int, int, Record]]:
        """Column, row and record of blocks."""
        places = zip(self.index["x"][numbers].tolist(), self.index["y"][numbers].tolist(), strict=True)
        for (x, y), record in zip(places, map(bytes, self.records(numbers)), strict=True):
            if not is_sound(record):
                raise self._damaged(f"block {x}, {y}")
            yield x, y, record

    def _read_end(self, size: int) -> tuple[Header, Table]:
        if size < len(MAGIC) + TAIL.size:
            raise self._damaged("its end")
        blocks, header_bytes, crc32, magic = TAIL.unpack(self._read(size - TAIL.size, TAIL.size))
        index_bytes = blocks * INDEX.itemsize
        first = size - TAIL.size - header_bytes - index_bytes
        if magic != MAGIC or first < len(MAGIC):
            raise self._damaged("its end")
        data = self._read(first, index_bytes + header_bytes)
        if zlib.crc32(data) != crc32:
            raise self._damaged("its index")
        try:
            return Header(**json.loads(data[index_bytes:].tobytes())), np.frombuffer(data[:index_bytes], INDEX)
        except (TypeError, ValueError):
            raise self._damaged("its header") from None

    def _read(self, first: int, length: int) -> memoryview:
        data = np.empty(length, np.uint8).data
        if length and os.preadv(self._file.fileno(), [data], first) != length:
            raise self._damaged("its length")
        return data

    def _damaged(self, what: str) -> DamagedError:
        return DamagedError(self.path, f"{what} is damaged; it is made again")


class CheckpointWriter:
    """Writes a new checkpoint: `add` blocks in order, then `finish`. Raises OSError."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._index: list[Table] = []
        self.bytes_written = file.write(MAGIC)

    def add(self, x: int, y: int, record: Record) -> None:
        """Write a block."""
        self._put(np.array([(x, y, 0, len(record), zlib.crc32(record))], INDEX), record)

    def copy(self, source: Checkpoint, numbers: Ints) -> None:
        """Copy blocks of another checkpoint."""
        for number, record in zip(numbers.tolist(), source.records(numbers), strict=True):
            self._put(source.index[number : number + 1].copy(), record)

    def finish(self, header: Header) -> None:
        """Write index, header and tail."""
        index = np.concatenate([np.empty(0, INDEX), *self._index])
        end = index.tobytes() + json.dumps(asdict(header)).encode()
        tail = TAIL.pack(len(index), len(end) - index.nbytes, zlib.crc32(end), MAGIC)
        self.bytes_written += self._file.write(end + tail)

    def _put(self, entry: Table, data: bytes | memoryview) -> None:
        entry["first"] = self.bytes_written
        self._index.append(entry)
        self.bytes_written += self._file.write(data)


def write_checkpoint(path: Path, header: Header, state: GridState) -> None:
    """Write a grid's whole state. Raises OSError."""
    with whole_file(path, PRIVATE) as file:
        writer = CheckpointWriter(file)
        for x, y, record in state.blocks:
            writer.add(x, y, record)
        writer.finish(header.with_totals(state))
