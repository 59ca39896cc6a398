"""Records, compiled: the pages of a block in one run of bytes, each number in as little as it needs.

    header   6 int32: pages, marks, words, votes, wide, runs; 4 uint64, a bit for each cell with evidence
    table    a row of 6 int32 for each page: tier, index, end of its runs and votes, first and end of its marks
    marks    4 bytes for each cell of a page: number; where its visits, machines and stamp stand among the page's words
    words    uint64, for each page: how many of the three there are, 9 bits each; then these, all different
    counts   uint16 for each vote; where `wide` is 1, uint16 more for the upper bits of each
    places   1 byte for each vote: its cell
    runs     2 bytes for each run of votes of one plane: plane, and number of its votes less one

All begin at whole multiples of what they consist of, and a record fills up its last 8 bytes. Kernels take a run of
records as four views of it: bytes, uint16, int32, uint64. Between them, a vote is one number: the place (plane * 256 +
cell) in its lower 16 bits, its count above; a table (n, 6) has tier, index, first and end of the votes and of the cells
of each page; cells are CELL.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNTS
from mapserver.evidence.fold_config import HASH

FIELDS = 6  # of the header, before the bits
HEADER_BYTES = FIELDS * 4 + CELLS // 8
_ROW_BYTES, _MARK_BYTES, _WORD_BYTES = 24, 4, 8
_PLANE, _CELL = np.uint64(0xFF00), np.uint64(CELLS - 1)  # of a place
_LOW, _NARROW_END = np.uint64(0xFFFF), np.uint64(1 << 32)  # of a count; of a vote whose count has 16 bits
_ONE, _HASH = np.uint64(1), np.uint64(HASH)  # unsigned, as indices below: the compiler need not look for negative ones
_SLOTS = 1024  # of a hash table: a list has 256 words at most


@numba.njit(cache=True, nogil=True)
def record_bytes(pages: int, marks: int, words: int, votes: int, wide: int, runs: int) -> int:
    """Length of a record, whose header has these numbers."""
    before_words = HEADER_BYTES + _ROW_BYTES * pages + (_MARK_BYTES * marks + 7) // 8 * 8
    return int((before_words + _WORD_BYTES * words + (3 + 2 * wide) * votes + 2 * runs + 7) // 8 * 8)


@numba.njit(cache=True, nogil=True)
def parts(data: Any, at: int) -> Any:
    """Table, marks, words, counts, high, places and runs of the record that begins at a byte."""
    whole, halves, quarters, eighths = data
    pages, marks, words, votes, wide, runs = quarters[at >> 2 : (at >> 2) + FIELDS]
    table = at + HEADER_BYTES
    mark = table + _ROW_BYTES * pages
    word = mark + (_MARK_BYTES * marks + 7) // 8 * 8
    count = word + _WORD_BYTES * words
    high = count + 2 * votes
    place = high + 2 * votes * wide
    run = place + votes
    return (
        quarters[table >> 2 : mark >> 2].reshape(pages, 6),
        whole[mark : mark + _MARK_BYTES * marks].reshape(marks, 4),
        eighths[word >> 3 : count >> 3],
        halves[count >> 1 : high >> 1],
        halves[high >> 1 : place >> 1],
        whole[place:run],
        whole[run : run + 2 * runs].reshape(runs, 2),
    )


@numba.njit(cache=True, nogil=True)
def read_record(data: Any, at: int, table: Any, votes: Any, cells: Any, done: Any) -> tuple[int, int, int]:
    """Write the pages of a record behind the pages, votes and cells that are done; returns how many are done then."""
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
    """Put votes together from the parts of a record."""
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
    """Where visits, machines and stamps of the page begin whose words begin here, and where they end."""
    sizes, visits = words[at], at + 1
    machines = visits + int(sizes & np.uint64(511))
    stamps = machines + int(sizes >> np.uint64(9) & np.uint64(511))
    return visits, machines, stamps, stamps + int(sizes >> np.uint64(18))


@numba.njit(cache=True, nogil=True)
def _read_cells(table: Any, marks: Any, words: Any, out: Any) -> None:
    at = 0
    for p in range(len(table)):
        visits, machines, stamps, at = _words_of(words, at)
        for j in range(table[p, 4], table[p, 5]):
            out[j].cell = marks[j, 0]
            out[j].visits = words[visits + marks[j, 1]]
            out[j].machines = words[machines + marks[j, 2]]
            out[j].newest_ns = np.int64(words[stamps + marks[j, 3]])


@numba.njit(cache=True, nogil=True)
def new_slots() -> Any:
    """Scratch of `write_record`: a hash table that knows by the number of a list, its last element, what is new."""
    return np.zeros(_SLOTS + 1, np.int64)


@numba.njit(cache=True, nogil=True)
def write_record(table: Any, votes: Any, cells: Any, slots: Any, out: Any, at: int) -> Any:
    """Write pages, whose votes and cells lie end to end, as a record; returns where it ends."""
    whole, halves, quarters, eighths = out
    pages, vote, cell = len(table), 0, 0
    if pages:
        votes, cells = votes[table[0, 2] : table[-1, 3]], cells[table[0, 4] : table[-1, 5]]
        vote, cell = table[0, 2], table[0, 4]
    wide = 0
    for packed in votes:
        wide |= packed >= _NARROW_END
    head, known, rows = at >> 2, (at >> 3) + FIELDS // 2, (at + HEADER_BYTES) >> 2
    mark = at + HEADER_BYTES + _ROW_BYTES * pages
    word = mark + (_MARK_BYTES * len(cells) + 7) // 8 * 8
    eighths[known : known + CELLS // 64] = 0
    eighths[mark >> 3 : word >> 3] = 0
    marks = whole[mark : mark + _MARK_BYTES * len(cells)].reshape(len(cells), 4)
    words = _write_cells(table, cells, cell, slots, eighths[known:], marks, eighths[word >> 3 :])
    count = word + _WORD_BYTES * words
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
    """Split votes into counts, cells and runs, and write where both end into the rows; returns how many runs."""
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
    """Replace bitmaps and stamps of cells by numbers of words, and set bits of known cells; returns how many words."""
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
    """A record for each block. ends, out_ends (b,): of the pages of each block, and of its record."""
    slots, first, at = new_slots(), 0, 0
    for block in range(len(ends)):
        at = write_record(table[first : ends[block]], votes, cells, slots, out, at)
        out_ends[block], first = at, ends[block]


@numba.njit(cache=True, nogil=True)
def sum_planes(data: Any, first: int, out: Any) -> None:
    """Add the votes of planes from `first` on of one record to out (planes, 256)."""
    _, _, _, counts, high, places, runs = parts(data, 0)
    at = np.int64(0)
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
    """Place (n,) of each page in the order of time: coarser tiers first, as in each cell the finer one is newer."""
    out = np.zeros(len(table), np.int64)
    for p in range(len(table)):
        for q in range(len(table)):
            out[p] += table[q, 0] > table[p, 0] or (table[q, 0] == table[p, 0] and q < p)
    return out


@numba.njit(cache=True, nogil=True)
def votes_in_time(data: Any, out: Any, ends: Any) -> None:
    """Votes of one record, pages in the order of time, and where those of each page end (n,)."""
    table, _, _, counts, high, places, runs = parts(data, 0)
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
    """Add records, each of another block, to counts (b, 256, COUNTS), bitmaps (b, 256, 2) and newest_ns (b, 256).

    begins (b,): of the records in data. start (b, 256): the place in the order of time of the first page that counts in
    each cell.
    """
    for block in range(len(begins)):
        table, marks, words, low, high, places, runs = parts(data, begins[block])
        rank, run, vote, word = ranks(table), 0, 0, 0
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
    """Whether these can be the votes of pages: what is read from a disk is looked at before it is read."""
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
    """Likewise, whether these can be the cells of pages, and known (4,) their bits."""
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
