"""Writes records (compiled); layout in record_kernels.py."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, ZERO
from mapserver.evidence.fold_config import HASH
from mapserver.evidence.record_kernels import FIELDS, HEADER_BYTES, MARK_BYTES, ROW_BYTES, WORD_BYTES

_PLANE, _CELL = np.uint64(0xFF00), np.uint64(CELLS - 1)  # masks of a place
_LOW, _NARROW_END = np.uint64(0xFFFF), np.uint64(1 << 32)  # mask of a count; first vote whose count exceeds 16 bits
_ONE, _HASH = np.uint64(1), np.uint64(HASH)  # unsigned, to avoid checks for negative indices
_SLOTS = 1024  # size of the hash table; a list has 256 words at most


@numba.njit(cache=True, nogil=True)
def new_slots() -> Any:
    """Hash table of `write_record`; its last element numbers lists, which saves clearing."""
    return np.zeros(_SLOTS + 1, np.int64)


@numba.njit(cache=True, nogil=True)
def write_record(table: Any, votes: Any, cells: Any, slots: Any, out: Any, at: int) -> Any:
    """Write consecutive pages as a record; returns its end."""
    whole, halves, quarters, eighths = out
    pages, vote, cell = len(table), 0, 0
    if pages:
        votes, cells = votes[table[0, 2] : table[-1, 3]], cells[table[0, 4] : table[-1, 5]]
        vote, cell = table[0, 2], table[0, 4]
    wide = 0
    for packed in votes:
        wide |= packed >= _NARROW_END
    head, known, rows = at >> 2, (at >> 3) + FIELDS // 2, (at + HEADER_BYTES) >> 2
    mark = at + HEADER_BYTES + ROW_BYTES * pages
    word = mark + (MARK_BYTES * len(cells) + 7) // 8 * 8
    eighths[known : known + CELLS // 64] = 0
    eighths[mark >> 3 : word >> 3] = 0
    marks = whole[mark : mark + MARK_BYTES * len(cells)].reshape(len(cells), 4)
    words = _write_cells(table, cells, cell, slots, eighths[known:], marks, eighths[word >> 3 :])
    count = word + WORD_BYTES * words
    high = count + 2 * len(votes)
    place = high + 2 * len(votes) * wide
    run = place + len(votes)
    runs = _write_votes(
        table, votes, vote, quarters[rows:], halves[count >> 1 : high >> 1], halves[high >> 1 : place >> 1],
        whole[place:run], whole[run:],
    )  # fmt: skip
    for p in range(pages):
        row = rows + 6 * p
        quarters[row], quarters[row + 1] = table[p, 0], table[p, 1]
        quarters[row + 4], quarters[row + 5] = table[p, 4] - cell, table[p, 5] - cell
    quarters[head], quarters[head + 1], quarters[head + 2] = pages, len(cells), words
    quarters[head + 3], quarters[head + 4], quarters[head + 5] = len(votes), wide, runs
    end = run + 2 * runs
    filled = (end + 7) // 8 * 8
    whole[end:filled] = 0
    return filled


@numba.njit(cache=True, nogil=True)
def _write_votes(table: Any, votes: Any, first: int, rows: Any, counts: Any, high: Any, places: Any, runs: Any) -> int:
    """Split votes into counts, cells and runs; returns the number of runs."""
    used, i = 0, np.uint64(0)
    for p in range(len(table)):
        end = np.uint64(table[p, 3] - first)
        while i < end:
            plane = votes[i] & _PLANE
            begin = i
            while i < end and votes[i] & _PLANE == plane:
                places[i] = votes[i] & _CELL
                counts[i] = votes[i] >> np.uint64(16) & _LOW
                i += _ONE
            runs[2 * used], runs[2 * used + 1] = plane >> np.uint64(8), i - begin - _ONE
            used += 1
        rows[6 * p + 2], rows[6 * p + 3] = used, end
    for j in range(np.uint64(len(high))):
        high[j] = votes[j] >> np.uint64(32)
    return used


@numba.njit(cache=True, nogil=True)
def _write_cells(table: Any, cells: Any, first: int, slots: Any, known: Any, marks: Any, words: Any) -> Any:
    """Replace bitmaps and stamps by indices of words, and set the known bits; returns the number of words."""
    used, list_number = np.uint64(0), slots[_SLOTS]
    for p in range(len(table)):
        cells_of_page = range(np.uint64(table[p, 4] - first), np.uint64(table[p, 5] - first))
        header = used
        used += _ONE
        sizes = np.uint64(0)
        for part in range(3):
            begin = used
            list_number += 1
            for j in cells_of_page:
                if part == 0:
                    word = cells[j].visits
                elif part == 1:
                    word = cells[j].machines
                else:
                    word = np.uint64(cells[j].newest_ns)
                slot = (word * _HASH) >> np.uint64(54)
                while slots[slot] >> 16 == list_number and words[begin + np.uint64(slots[slot] & 0xFFFF)] != word:
                    slot = (slot + _ONE) & np.uint64(_SLOTS - 1)
                if slots[slot] >> 16 != list_number:
                    slots[slot] = list_number << 16 | np.int64(used - begin)
                    words[used] = word
                    used += _ONE
                marks[j, np.uint64(1 + part)] = slots[slot] & 0xFFFF
            sizes |= (used - begin) << np.uint64(9 * part)
        words[header] = sizes
        for j in cells_of_page:
            number = np.uint64(cells[j].cell)
            marks[j, 0] = number
            known[number >> np.uint64(6)] |= _ONE << (number & np.uint64(63))
    slots[_SLOTS] = list_number
    return used


@numba.njit(cache=True, nogil=True)
def write_records(ends: Any, table: Any, votes: Any, cells: Any, out: Any, out_ends: Any) -> None:
    """One record for each block. ends, out_ends (b,): of its pages and its record."""
    slots, first, at = new_slots(), 0, ZERO
    for block in range(len(ends)):
        at = write_record(table[first : ends[block]], votes, cells, slots, out, at)
        out_ends[block], first = at, ends[block]
