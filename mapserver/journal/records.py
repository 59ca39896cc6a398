"""Journal rows as bytes, one record each, and their bulk decoding.

A record is little-endian: HEAD, machine name, samples as SAMPLE_DTYPE, CRC-32 of all that. The CRC-32 of a whole record
is then always SOUND, so it is checked before anything is decoded.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import ZERO
from mapserver.journal.rows import JournalRow, JournalRows
from protocol.arrays import AnyArray, Bools, Ints, Table
from protocol.machine.samples import SAMPLE_DTYPE

HEAD = np.dtype(
    [("row", "<i8"), ("received_ns", "<i8"), ("spool_id", "<u8"), ("first_seq", "<i8"), ("name_bytes", "u1")]
)
SOUND = 0x2144DF1C  # CRC-32 of any data followed by its CRC-32
_HEAD_BYTES, _SAMPLE_BYTES, _CRC_BYTES = HEAD.itemsize, SAMPLE_DTYPE.itemsize, 4


def record(row: JournalRow) -> bytes:
    """Encode a row."""
    name = row.machine.encode()
    head = np.array((row.row, row.received_ns, row.spool_id, row.first_seq, len(name)), HEAD)
    body = head.tobytes() + name + row.rows.tobytes()
    return body + zlib.crc32(body).to_bytes(_CRC_BYTES, "little")


def checksum_of(record: bytes) -> int:
    """A record's checksum."""
    return int.from_bytes(record[-_CRC_BYTES:], "little")


def last_checksum(rows: JournalRows) -> int:
    """Checksum of the last row."""
    (last,) = rows.chosen(rows.numbers == rows.numbers[-1])
    return checksum_of(record(last))


def warm_up() -> None:
    """Compile the kernels, or load them, before a batch waits for them."""
    row = JournalRow(1, "", 1, 1, np.zeros(1, SAMPLE_DTYPE))
    decoded([1], [record(row)])
    extent_of(row.rows)


@numba.njit(cache=True, nogil=True)
def extent_of(samples: Table) -> tuple[int, int, float, float, float, float]:
    """Extent of samples: first and last stamp, west, south, east, north.

    Never -0.0, which databases turn into 0.0, with another checksum.
    """
    first = samples[0]
    first_ns = last_ns = first.stamp_ns
    west_m, south_m, east_m, north_m = first.x_m, first.y_m, first.x_m, first.y_m
    for sample in samples:
        first_ns, last_ns = min(first_ns, sample.stamp_ns), max(last_ns, sample.stamp_ns)
        west_m, east_m = min(west_m, sample.x_m), max(east_m, sample.x_m)
        south_m, north_m = min(south_m, sample.y_m), max(north_m, sample.y_m)
    return first_ns, last_ns, west_m + 0.0, south_m + 0.0, east_m + 0.0, north_m + 0.0


def decoded(numbers: Sequence[int], records: Sequence[Any]) -> JournalRows:
    """Decode rows up to the first damaged or misnumbered record."""
    n = _first(_checks(records) != SOUND)
    ends = np.cumsum(np.fromiter(map(len, records[:n]), np.int64, n))
    data = np.frombuffer(b"".join(records[:n]), np.uint8)
    heads = np.empty((n, _HEAD_BYTES), np.uint8)
    lengths, machine, firsts = (np.empty(n, np.int64) for _ in range(3))
    samples: Table = np.empty(len(data) // _SAMPLE_BYTES, SAMPLE_DTYPE)
    slots = np.full(1 << (2 * n + 1).bit_length(), -1)
    used, machines = _split(data, ends, heads, lengths, machine, firsts, samples.view(np.uint8), slots)
    head = heads.view(HEAD)[:, 0]
    names = (records[at][_HEAD_BYTES : _HEAD_BYTES + head["name_bytes"][at]] for at in firsts[:machines].tolist())
    columns = (np.ascontiguousarray(head[name]) for name in ("row", "spool_id", "first_seq", "received_ns"))
    rows = JournalRows(samples[:used], lengths, tuple(name.decode() for name in names), machine, *columns)
    return rows.first(_first(rows.numbers != np.array(numbers[:n], np.int64)))


def _checks(records: Sequence[Any]) -> Ints:
    try:
        return np.fromiter(map(zlib.crc32, records), np.int64, len(records))
    except TypeError:  # damage may change a value's type
        return np.array([zlib.crc32(each) if isinstance(each, bytes) else -1 for each in records], np.int64)


def _first(wrong: Bools) -> int:
    """Number before the first wrong one."""
    return int(wrong.argmax()) if wrong.any() else len(wrong)


@numba.njit(cache=True, nogil=True)
def _split(
    data: AnyArray,
    ends: Any,
    heads: AnyArray,
    lengths: Any,
    machine: Any,
    firsts: Any,
    samples: AnyArray,
    slots: Any,
) -> tuple[int, int]:
    """Split records; returns the numbers of samples and machines.

    data: consecutive records, ending at ends (k,). Fills heads (k, bytes), lengths (k,) in samples, machine (k,) name
    numbers, firsts: first record of each name, samples (bytes). slots: -1, more than twice as many as records.
    """
    begin, used, names = 0, 0, ZERO
    for k in range(len(ends)):
        for i in range(_HEAD_BYTES):
            heads[k, i] = data[begin + i]
        first = begin + _HEAD_BYTES
        middle = first + data[first - 1]
        machine[k] = _number_of(data, first, middle, k, names, ends, firsts, slots)
        names = max(names, machine[k] + 1)
        n = ends[k] - _CRC_BYTES - middle
        samples[used : used + n] = data[middle : middle + n]
        lengths[k] = n // _SAMPLE_BYTES
        begin, used = ends[k], used + n
    return used // _SAMPLE_BYTES, names


@numba.njit(cache=True, nogil=True)
def _number_of(data: AnyArray, first: int, end: int, k: int, names: int, ends: Any, firsts: Any, slots: Any) -> int:
    """Number of the name in data[first:end]; `names` for a new one."""
    place = np.uint64(14695981039346656037)  # FNV-1a hash
    for i in range(first, end):
        place = (place ^ np.uint64(data[i])) * np.uint64(1099511628211)
    slot = np.int64(place & np.uint64(len(slots) - 1))
    while slots[slot] >= 0:
        other = firsts[slots[slot]]
        begin = (ends[other - 1] if other else 0) + _HEAD_BYTES
        if data[begin - 1] == end - first:
            same = True
            for i in range(end - first):
                same &= data[begin + i] == data[first + i]
            if same:
                return int(slots[slot])
        slot = (slot + 1) & (len(slots) - 1)
    slots[slot], firsts[names] = names, k
    return names
