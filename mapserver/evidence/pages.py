"""Pages: packed, immutable evidence of one block over a span of time.

They keep only counts other than zero (about ten of 108 per cell), bitmaps and newest stamps. A block's pages form one
`Record` of bytes, about 45 per cell and page, in memory, snapshots and checkpoints, read without copies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapserver.evidence import record_kernels
from mapserver.evidence.record_writing import write_records
from protocol.arrays import AnyArray, Ints, Table

# place: bin * 256 + cell. If a count exceeds 16 bits, all of the block are wide.
TIERS = 4  # tiers of a timeline: buckets, hours, days, all before
NARROW = np.dtype([("place", "<u2"), ("count", "<u2")])
WIDE = np.dtype([("place", "<u2"), ("count", "<u4")])
CELL = np.dtype([("cell", "u1"), ("visits", "<u8"), ("machines", "<u8"), ("newest_ns", "<i8")])
Record = bytes  # of a block; layout in record_kernels.py
_PAGES, _MARKS, _VOTES = 0, 1, 3  # indices in a record's header
_KNOWN = slice(record_kernels.FIELDS * 4, record_kernels.HEADER_BYTES)


@dataclass(frozen=True, slots=True)
class Page:
    """Votes (m,) NARROW or WIDE by place, and cells (k,) CELL by number."""

    votes: Table
    cells: Table


class Pages(NamedTuple):
    """Unpacked pages of one block, in few arrays.

    table (n, 6): tier, index, first and end of votes and of cells. votes (m,) uint64: place in the lower 16 bits, count
    above; cells (k,) CELL.
    """

    table: Ints
    votes: NDArray[np.uint64]
    cells: Table

    @classmethod
    def unpacked(cls, record: Record) -> Pages:
        """Inverse of `record`."""
        header = np.frombuffer(record, np.int32, record_kernels.FIELDS)
        shapes = (int(header[_PAGES]), 6), int(header[_VOTES]), int(header[_MARKS])
        pages = cls(*map(np.empty, shapes, (np.int64, np.uint64, CELL)))  # type: ignore[arg-type]
        record_kernels.read_record(as_numbers(record), 0, *pages, (0, 0, 0))
        return pages

    @property
    def record(self) -> Record:
        """All pages, packed."""
        (record,) = records(np.array([len(self.table)]), *self, np.empty(most_bytes(*self), np.uint8))
        return record

    def items(self) -> Iterator[tuple[int, int, Page]]:
        """Tier, index and page."""
        votes: Table = np.empty(len(self.votes), NARROW if int(self.votes.max(initial=0)) < 2**32 else WIDE)
        votes["place"], votes["count"] = self.votes & np.uint64(0xFFFF), self.votes >> np.uint64(16)
        for tier, index, first, end, first_cell, end_cell in self.table.tolist():
            yield tier, index, Page(votes[first:end], self.cells[first_cell:end_cell])


def as_numbers(data: bytes | AnyArray) -> tuple[AnyArray, ...]:
    """Views for kernels: bytes, and numbers of 16, 32 and 64 bits."""
    whole = np.frombuffer(data, np.uint8)
    return whole, whole.view(np.uint16), whole.view(np.int32), whole.view(np.uint64)


def page_count(record: Record) -> int:
    """Number of pages."""
    return int.from_bytes(record[:4], "little")


def vote_count(record: Record) -> int:
    """Number of votes."""
    return int.from_bytes(record[12:16], "little")


def known_cells(record: Record) -> int:
    """A bit for each cell with evidence."""
    return int.from_bytes(record[_KNOWN], "little")


def most_bytes(table: Ints, votes: NDArray[np.uint64], cells: Table) -> int:
    """Upper bound for one block per page: three paddings to 8 bytes."""
    fixed = record_kernels.HEADER_BYTES + 24 + 8 + 24
    return (fixed * max(1, len(table)) + 7 * len(votes) + 28 * len(cells) + 7) // 8 * 8


def records(ends: Ints, table: Ints, votes: NDArray[np.uint64], cells: Table, space: AnyArray) -> list[Record]:
    """The record of each block. ends (b,): end of its pages; space: at least `most_bytes` to work in.

    table (n, 6), votes, cells: as in Pages, of all blocks.
    """
    out_ends = np.empty_like(ends)
    write_records(ends, table, votes, cells, as_numbers(space), out_ends)
    return cut(space, out_ends)


def cut(space: AnyArray, ends: Ints) -> list[Record]:
    """Copies of consecutive records."""
    whole, all_ends = space.data, ends.tolist()
    return [bytes(whole[first:end]) for first, end in zip([0, *all_ends], all_ends, strict=False)]


def is_sound(record: bytes) -> bool:
    """Whether bytes are a record: the only check before unpacking."""
    if len(record) < record_kernels.HEADER_BYTES or len(record) % 8:
        return False
    header = np.frombuffer(record, np.int32, record_kernels.FIELDS).tolist()
    if min(header) < 0 or header[4] > 1 or record_kernels.record_bytes(*header) != len(record):
        return False
    numbers = as_numbers(record)
    table, marks, words, counts, _, places, runs = record_kernels.parts(numbers, 0)
    tier, index = table[:, 0], table[:, 1]
    in_place = bool((tier >= 0).all() and (tier < TIERS).all() and (index >= 0).all())
    known = np.frombuffer(record[_KNOWN], np.uint64)
    votes = in_place and record_kernels.are_votes(table, runs, places, counts)
    return bool(votes and record_kernels.are_cells(table, marks, words, known))


EMPTY = Pages(np.empty((0, 6), np.int64), np.empty(0, np.uint64), np.empty(0, CELL)).record
