"""Records (compiled): a block's pages in one run of bytes.

    header   6 int32: pages, marks, words, votes, wide, runs; 4 uint64, a bit per cell with evidence
    table    6 int32 per page: tier, index, end of its runs and votes, first and end of its marks
    marks    4 bytes per cell: number; indices of visits, machines, stamp in the page's words
    words    uint64, per page: counts of these three, 9 bits each; then distinct values
    counts   uint16 per vote; if `wide` is 1, then uint16 of upper bits
    places   1 byte per vote: cell
    runs     2 bytes per run of votes of one plane: plane, number of votes less one

Parts are aligned, records padded to 8 bytes. Kernels take views of bytes, uint16, int32, uint64. Unpacked votes have
their place (plane * 256 + cell) in the lower 16 bits, their count above; tables (n, 6) have tier, index, first and end
of votes and of cells; cells are CELL.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNTS, ZERO

FIELDS = 6  # numbers in the header, before the bits
HEADER_BYTES = FIELDS * 4 + CELLS // 8
ROW_BYTES, MARK_BYTES, WORD_BYTES = 24, 4, 8
_ONE = np.uint64(1)  # unsigned, to avoid checks for negative indices


@numba.njit(cache=True, nogil=True)
def record_bytes(pages: int, marks: int, words: int, votes: int, wide: int, runs: int) -> int:
    """Length of a record with this header."""
    before_words = HEADER_BYTES + ROW_BYTES * pages + (MARK_BYTES * marks + 7) // 8 * 8
    return int((before_words + WORD_BYTES * words + (3 + 2 * wide) * votes + 2 * runs + 7) // 8 * 8)


@numba.njit(cache=True, nogil=True)
def parts(data: Any, at: int) -> Any:
    """Table, marks, words, counts, high, places and runs of the record at a byte."""
    whole, halves, quarters, eighths = data
    pages, marks, words, votes, wide, runs = quarters[at >> 2 : (at >> 2) + FIELDS]
    table = at + HEADER_BYTES
    mark = table + ROW_BYTES * pages
    word = mark + (MARK_BYTES * marks + 7) // 8 * 8
    count = word + WORD_BYTES * words
    high = count + 2 * votes
    place = high + 2 * votes * wide
    run = place + votes
    return (
        quarters[table >> 2 : mark >> 2].reshape(pages, 6),
        whole[mark : mark + MARK_BYTES * marks].reshape(marks, 4),
        eighths[word >> 3 : count >> 3],
        halves[count >> 1 : high >> 1],
        halves[high >> 1 : place >> 1],
        whole[place:run],
        whole[run : run + 2 * runs].reshape(runs, 2),
    )


@numba.njit(cache=True, nogil=True)
def read_record(data: Any, at: int, table: Any, votes: Any, cells: Any, done: Any) -> tuple[int, int, int]:
    """Append a record's pages; returns the new numbers of pages, votes, cells."""
    rows, marks, words, counts, high, places, runs = parts(data, at)
    pages, vote, cell = done
    for p in range(len(rows)):
        row = table[pages + p]
        row[0], row[1] = rows[p, 0], rows[p, 1]
        row[2], row[3] = vote + (rows[p - 1, 3] if p else 0), vote + rows[p, 3]
        row[4], row[5] = cell + rows[p, 4], cell + rows[p, 5]
    read_votes(runs, places, counts, high, votes[vote:])
    _read_cells(rows, marks, words, cells[cell:])
    return pages + len(rows), vote + len(counts), cell + len(marks)


@numba.njit(cache=True, nogil=True)
def read_votes(runs: Any, places: Any, counts: Any, high: Any, out: Any) -> None:
    """Assemble votes from parts."""
    at = np.uint64(0)
    for r in range(len(runs)):
        plane = np.uint64(runs[r, 0]) << np.uint64(8)
        end = at + np.uint64(runs[r, 1]) + _ONE
        for i in range(at, end):
            out[i] = (np.uint64(counts[i]) << np.uint64(16)) | plane | np.uint64(places[i])
        at = end
    for i in range(np.uint64(len(high))):
        out[i] |= np.uint64(high[i]) << np.uint64(32)


@numba.njit(cache=True, nogil=True)
def _words_of(words: Any, at: int) -> tuple[int, int, int, int]:
    """Begins of a page's visits, machines and stamps, and their end."""
    sizes, visits = words[at], at + 1
    machines = visits + int(sizes & np.uint64(511))
    stamps = machines + int(sizes >> np.uint64(9) & np.uint64(511))
    return visits, machines, stamps, stamps + int(sizes >> np.uint64(18))


@numba.njit(cache=True, nogil=True)
def _read_cells(table: Any, marks: Any, words: Any, out: Any) -> None:
    at = ZERO
    for p in range(len(table)):
        visits, machines, stamps, at = _words_of(words, at)
        for j in range(table[p, 4], table[p, 5]):
            out[j].cell = marks[j, 0]
            out[j].visits = words[visits + marks[j, 1]]
            out[j].machines = words[machines + marks[j, 2]]
            out[j].newest_ns = np.int64(words[stamps + marks[j, 3]])


@numba.njit(cache=True, nogil=True)
def sum_planes(data: Any, first: int, out: Any) -> None:
    """Add votes of planes from `first` to out (planes, 256)."""
    _, _, _, counts, high, places, runs = parts(data, ZERO)
    at = ZERO
    for r in range(len(runs)):
        plane, end = np.int64(runs[r, 0]) - first, at + np.int64(runs[r, 1]) + 1
        if 0 <= plane < len(out):
            for i in range(at, end):
                out[plane, places[i]] += np.int64(counts[i])
            if len(high):
                for i in range(at, end):
                    out[plane, places[i]] += np.int64(high[i]) << 16
        at = end


@numba.njit(cache=True, nogil=True)
def ranks(table: Any) -> Any:
    """Ranks (n,) in time: coarser tiers first, as in each cell the finer is newer."""
    out = np.zeros(len(table), np.int64)
    for p in range(len(table)):
        for q in range(len(table)):
            out[p] += table[q, 0] > table[p, 0] or (table[q, 0] == table[p, 0] and q < p)
    return out


@numba.njit(cache=True, nogil=True)
def votes_in_time(data: Any, out: Any, ends: Any) -> None:
    """Votes of a record by pages in time, and the end of each page's (n,)."""
    table, _, _, counts, high, places, runs = parts(data, ZERO)
    rank, run, vote = ranks(table), 0, 0
    for p in range(len(table)):
        ends[rank[p]] = table[p, 3] - (table[p - 1, 3] if p else 0)
    for k in range(1, len(ends)):
        ends[k] += ends[k - 1]
    for p in range(len(table)):
        of_page = slice(vote, table[p, 3])
        first = ends[rank[p]] - (of_page.stop - vote)
        some_high = high[of_page] if len(high) else high
        read_votes(runs[run : table[p, 2]], places[of_page], counts[of_page], some_high, out[first:])
        run, vote = table[p, 2], table[p, 3]


@numba.njit(cache=True, nogil=True)
def sum_records(data: Any, begins: Any, start: Any, counts: Any, bitmaps: Any, newest_ns: Any) -> None:
    """Add records of different blocks to counts (b, 256, COUNTS), bitmaps (b, 256, 2), newest_ns (b, 256).

    start (b, 256): rank of the first page that counts in each cell.
    """
    for block in range(len(begins)):
        table, marks, words, low, high, places, runs = parts(data, begins[block])
        rank, run, vote, word = ranks(table), 0, 0, ZERO
        for p in range(len(table)):
            while run < table[p, 2]:
                plane, end = np.uint64(runs[run, 0]), vote + int(runs[run, 1]) + 1
                for i in range(vote, end):
                    if start[block, places[i]] <= rank[p]:
                        counts[block, places[i], plane] += low[i]
                        if len(high):
                            counts[block, places[i], plane] += np.uint64(high[i]) << np.uint64(16)
                run, vote = run + 1, end
            visits, machines, stamps, word = _words_of(words, word)
            for j in range(table[p, 4], table[p, 5]):
                cell = marks[j, 0]
                if start[block, cell] <= rank[p]:
                    bitmaps[block, cell, 0] |= words[visits + marks[j, 1]]
                    bitmaps[block, cell, 1] |= words[machines + marks[j, 2]]
                    newest_ns[block, cell] = max(newest_ns[block, cell], np.int64(words[stamps + marks[j, 3]]))


@numba.njit(cache=True, nogil=True)
def are_votes(table: Any, runs: Any, cells: Any, counts: Any) -> bool:
    """Whether data from disk can be votes."""
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
    return run == len(runs) and vote == len(counts)


@numba.njit(cache=True, nogil=True)
def are_cells(table: Any, marks: Any, words: Any, known: Any) -> bool:
    """Whether these can be cells; known (4,): their bits."""
    at, word, bits = 0, 0, np.zeros(CELLS // 64, np.uint64)
    for p in range(len(table)):
        if not (table[p, 4] == at and at < table[p, 5] <= len(marks) and word < len(words)):
            return False
        sizes = words[word]
        if sizes >> np.uint64(27):
            return False
        for part in range(3):
            size = int(sizes >> np.uint64(9 * part) & np.uint64(511))
            for j in range(at, table[p, 5]):
                if marks[j, 1 + part] >= size:
                    return False
            word += size
        word += 1
        for j in range(at, table[p, 5]):
            if j > at and marks[j, 0] <= marks[j - 1, 0]:
                return False
            bits[marks[j, 0] >> 6] |= _ONE << np.uint64(marks[j, 0] & 63)
        at = table[p, 5]
    return at == len(marks) and word == len(words) and (bits == known).all()
