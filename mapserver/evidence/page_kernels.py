"""Pages to their compact form and back, compiled.

In memory between kernels, a vote is one number: the place (plane * 256 + cell) in its lower 16 bits, its count above.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNTS
from mapserver.evidence.fold_config import HASH

_PLANE, _CELL = np.uint64(0xFF00), np.uint64(CELLS - 1)  # of a place
_LOW = np.uint64(0xFFFF)  # of a count
_ONE, _HASH = np.uint64(1), np.uint64(HASH)  # unsigned, as indices below: the compiler need not look for negative ones


@numba.njit(cache=True, nogil=True)
def compact_votes(table: Any, votes: Any, runs: Any, cells: Any, counts: Any, high: Any) -> int:
    """Split the votes of pages: runs of votes of one plane, their cells, and their counts.

    table (n, 6): as of PackedPages. Fills runs (m, 2) of plane and number of votes less one, cells (k,), counts (k,)
    with the lower 16 bits and, where it is not empty, high (k,) with the upper ones. Writes in each page's row where
    its runs end, in place of where its votes begin. Returns how many runs.
    """
    used, i = 0, 0
    for p in range(len(table)):
        end = table[p, 3]
        while i < end:
            plane = votes[i] & _PLANE
            first = i
            while i < end and votes[i] & _PLANE == plane:
                cells[i] = votes[i] & _CELL
                counts[i] = votes[i] >> np.uint64(16) & _LOW
                if len(high):
                    high[i] = votes[i] >> np.uint64(32)
                i += 1
            runs[used, 0], runs[used, 1] = plane >> np.uint64(8), i - first - 1
            used += 1
        table[p, 2] = used
    return used


@numba.njit(cache=True, nogil=True)
def expand_votes(table: Any, runs: Any, cells: Any, counts: Any, high: Any, out: Any) -> None:
    """Undo `compact_votes`; out (k,) votes. high may be empty. The table (n, 6) is put right again."""
    run, at = 0, np.uint64(0)
    for p in range(len(table)):
        end_run = table[p, 2]
        table[p, 2] = at
        while run < end_run:
            plane = np.uint64(runs[run, 0]) << np.uint64(8)
            end = at + np.uint64(runs[run, 1]) + _ONE
            for i in range(at, end):
                out[i] = (np.uint64(counts[i]) << np.uint64(16)) | plane | np.uint64(cells[i])
            at = end
            run += 1
        table[p, 3] = at
    for i in range(np.uint64(len(high))):
        out[i] |= np.uint64(high[i]) << np.uint64(32)


@numba.njit(cache=True, nogil=True)
def sum_planes(runs: Any, cells: Any, counts: Any, high: Any, first: int, out: Any) -> None:
    """Add the votes of planes from `first` on to out (planes, 256). runs, cells, counts, high: of CompactPages."""
    at = np.int64(0)
    for r in range(len(runs)):
        plane, end = np.int64(runs[r, 0]) - first, at + np.int64(runs[r, 1]) + 1
        if 0 <= plane < len(out):
            for i in range(at, end):
                out[plane, cells[i]] += np.int64(counts[i])
            if len(high):
                for i in range(at, end):
                    out[plane, cells[i]] += np.int64(high[i]) << 16
        at = end


@numba.njit(cache=True, nogil=True)
def compact_cells(table: Any, cells: Any, out: Any, words: Any, ends: Any) -> None:
    """Replace bitmaps and stamps of cells by numbers of words: each page has its own, all different, in one list.

    Fills out (k, 4): cell, and numbers of its visits, its machines and its stamp among the page's words; words (m,)
    uint64: for each page how many of the three there are, packed in 9 bits each, then the words; ends (n,) of the words
    of each page.
    """
    used = np.uint64(0)
    slots, list_number = np.zeros(1024, np.int64), 0  # of a hash table: number of the list, and of a word in it
    for p in range(len(table)):
        cells_of_page = range(np.uint64(table[p, 4]), np.uint64(table[p, 5]))
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
                    slot = (slot + _ONE) & np.uint64(1023)
                if slots[slot] >> 16 != list_number:
                    slots[slot] = list_number << 16 | np.int64(used - begin)
                    words[used] = word
                    used += _ONE
                out[j, np.uint64(1 + part)] = slots[slot] & 0xFFFF
            sizes |= (used - begin) << np.uint64(9 * part)
        words[header] = sizes
        for j in cells_of_page:
            out[j, 0] = cells[j].cell
        ends[p] = used


@numba.njit(cache=True, nogil=True)
def expand_cells(table: Any, compact: Any, words: Any, out: Any) -> None:
    """Undo `compact_cells`; out (k,) CELL."""
    at = 0
    for p in range(len(table)):
        sizes = words[at]
        visits = at + 1
        machines = visits + int(sizes & np.uint64(511))
        stamps = machines + int(sizes >> np.uint64(9) & np.uint64(511))
        at = stamps + int(sizes >> np.uint64(18))
        for j in range(table[p, 4], table[p, 5]):
            out[j].cell = compact[j, 0]
            out[j].visits = words[visits + compact[j, 1]]
            out[j].machines = words[machines + compact[j, 2]]
            out[j].newest_ns = np.int64(words[stamps + compact[j, 3]])


@numba.njit(cache=True, nogil=True)
def sum_pages(table: Any, votes: Any, cells: Any, start: Any, counts: Any, bitmaps: Any, newest_ns: Any) -> None:
    """Add pages, in the order of their table, to counts (256, COUNTS), bitmaps (256, 2) and newest_ns (256,).

    start (256,): the place in that order of the first page that counts in each cell.
    """
    for p in range(len(table)):
        for j in range(table[p, 2], table[p, 3]):
            place = votes[j] & _LOW
            cell = place & _CELL
            if start[cell] <= p:
                counts[cell, place >> np.uint64(8)] += votes[j] >> np.uint64(16)
        for j in range(table[p, 4], table[p, 5]):
            cell = np.uint64(cells[j].cell)
            if start[cell] <= p:
                bitmaps[cell, 0] |= cells[j].visits
                bitmaps[cell, 1] |= cells[j].machines
                newest_ns[cell] = max(newest_ns[cell], cells[j].newest_ns)


@numba.njit(cache=True, nogil=True)
def note(known: Any, cells: Any) -> int:
    """Set known (256,) for cells (k,) CELL; returns for how many it was not set."""
    more = 0
    for cell in cells:
        more += not known[cell.cell]
        known[cell.cell] = True
    return more


@numba.njit(cache=True, nogil=True)
def are_votes(table: Any, runs: Any, cells: Any, counts: Any, high: Any) -> bool:
    """Whether these can be the votes of pages: what is read from a disk is looked at before it is expanded."""
    run, vote = 0, 0
    for p in range(len(table)):
        plane = -1
        if not run <= table[p, 2] <= len(runs):
            return False
        while run < table[p, 2]:
            end = vote + int(runs[run, 1]) + 1
            if not plane < runs[run, 0] < COUNTS or end > len(cells):
                return False
            plane = int(runs[run, 0])
            for i in range(vote + 1, end):
                if cells[i] <= cells[i - 1]:
                    return False
            vote = end
            run += 1
        if table[p, 3] != vote:
            return False
    return run == len(runs) and vote == len(cells) == len(counts) and len(high) in (0, vote)


@numba.njit(cache=True, nogil=True)
def are_cells(table: Any, marks: Any, words: Any) -> bool:
    """Likewise, whether these can be the cells of pages."""
    at, word = 0, 0
    for p in range(len(table)):
        if not (table[p, 4] == at and at < table[p, 5] <= len(marks) and word < len(words)):
            return False
        for part in range(3):
            size = int(words[word] >> np.uint64(9 * part) & np.uint64(511))
            for j in range(at, table[p, 5]):
                if marks[j, 1 + part] >= size:
                    return False
        for j in range(at + 1, table[p, 5]):
            if marks[j, 0] <= marks[j - 1, 0]:
                return False
        sizes = words[word]
        for part in range(3):
            word += int(sizes >> np.uint64(9 * part) & np.uint64(511))
        word += 1
        at = table[p, 5]
    return at == len(marks) and word == len(words)
