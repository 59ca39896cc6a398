"""What a journal holds, as values: admitted batches, rows, watermarks, events; which rows to read; checksums."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from protocol.arrays import Table
from protocol.machine.readings import MAX_STAMP_NS
from protocol.machine.samples import SAMPLE_DTYPE
from protocol.site.geometry import Bounds
from protocol.wire.messages import SampleBatch

_EXTENT = struct.Struct("<3q4d")


@dataclass(frozen=True)
class Admission:
    """What of a batch is new. batch: trimmed to it; trimmed: samples it had already; lost: samples declared lost."""

    batch: SampleBatch
    trimmed: int
    lost: int

    @property
    def watermark(self) -> int:
        """The last sample that is on disk once this is committed."""
        return self.batch.last_seq


@dataclass(frozen=True)
class JournalRow:
    """One admitted batch as it lies on disk. received_ns: the server's clock when it came in."""

    row: int
    machine: str
    spool_id: int
    first_seq: int
    rows: Table
    received_ns: int = 0


@dataclass(frozen=True)
class Selection:
    """Which journal rows to read. A row that may hold a selected sample is given whole.

    from_ns, to_ns: rows with samples in from_ns <= stamp <= to_ns. bounds: rows whose samples' bounding box touches it.
    without: machines to exclude.
    """

    from_ns: int = 0
    to_ns: int = MAX_STAMP_NS
    bounds: Bounds | None = None
    without: frozenset[str] = frozenset()

    @property
    def everywhere(self) -> bool:
        """Whether neither time nor place excludes a row."""
        return self == Selection(without=self.without)


ALL = Selection()


@dataclass(frozen=True)
class Watermark:
    """Progress of one spool: the last committed sample, how many it declared lost, and its newest stamp."""

    seq: int = 0
    lost: int = 0
    newest_ns: int = 0


@dataclass(frozen=True)
class StoreIdentity:
    """Which store this is. id: drawn when it is made, and kept by its copies; descends: of what it was folded from."""

    id: str
    descends: tuple[str, ...] = ()


@dataclass(frozen=True)
class Event:
    """Something that the server has to remember and that is no sample; body: plain values."""

    id: int
    kind: str
    stamp_ns: int
    body: Mapping[str, Any]


def pack(rows: Table) -> bytes:
    """Encode samples for a journal row: a map from the name of each column to its bytes."""
    packed: bytes = msgpack.packb({name: rows[name].tobytes() for name in SAMPLE_DTYPE.names or ()})
    return packed


def unpack(payload: bytes) -> Table:
    """Undo `pack`."""
    columns = msgpack.unpackb(payload)
    rows = np.zeros(len(columns["stamp_ns"]) // 8, SAMPLE_DTYPE)
    for name in SAMPLE_DTYPE.names or ():
        rows[name] = np.frombuffer(columns[name], SAMPLE_DTYPE[name])
    return rows


def extent_checksum(row: int, first_ns: int, last_ns: int, *box: float) -> int:
    """CRC-32 of when and where a row lies, ten times as fast as `checksum`; -1 where a value has the wrong type."""
    try:
        return zlib.crc32(_EXTENT.pack(row, first_ns, last_ns, *box))
    except struct.error:
        return -1


def checksum(*values: object) -> int:
    """CRC-32 of plain values, bytes among them."""
    crc32 = 0
    for value in values:
        crc32 = zlib.crc32(value if isinstance(value, bytes) else repr(value).encode(), crc32)
    return crc32
