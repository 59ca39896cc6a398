"""Settles timelines (compiled): all records of a block into one."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence.cells import CELLS, COUNT_MAX, COUNTS, ZERO
from mapserver.evidence.record_kernels import read_record
from mapserver.evidence.record_writing import new_slots, write_record

_INDEX_BITS = 40  # bits of a span's index, below its tier
# unsigned indices avoid checks for negative ones


@numba.njit(cache=True, nogil=True)
def settle_blocks(
    ends: Any, starts: Any, data: Any, spans: Any, keeps: Any, scratch: Any, out: Any, out_ends: Any
) -> None:
    """Settle blocks; each cell keeps its newest spans of each tier apart.

    ends (b,): of each block's records; starts (r,): of records. spans, keeps: length [ns] and number by tier; the last
    has span 0. scratch, for one block: tables, votes, cells before and after, an int8 per cell before, counts (COUNTS *
    256,) uint64, zero before and after. Fills records and ends.
    """
    before, after, tiers, counts = scratch
    table, votes, cells = before
    slots, at, record = new_slots(), ZERO, 0
    for block in range(len(ends)):
        done = ZERO, ZERO, ZERO
        while record < ends[block]:
            done = read_record(data, starts[record], table, votes, cells, done)
            record += 1
        pages = _settle(table[: done[0]], votes, cells, spans, keeps, counts, tiers, after)
        at = write_record(after[0][:pages], after[1], after[2], slots, out, at)
        out_ends[block] = at


@numba.njit(cache=True, nogil=True)
def _settle(table: Any, votes: Any, cells: Any, spans: Any, keeps: Any, counts: Any, tiers: Any, after: Any) -> int:
    """Write a block's pages to `after`, by tier and index; returns their number."""
    out_table, out_votes, out_cells = after
    pages, used, filled = 0, ZERO, ZERO
    indices = _indices(table, spans)
    _find_tiers(table, indices, cells, keeps, tiers)
    held, spread = _held(table, tiers, len(spans))
    wanted: Any = np.zeros(CELLS, np.bool_)
    planes = np.zeros(COUNTS, np.bool_)
    visits, machines, newest = np.zeros(CELLS, np.uint64), np.zeros(CELLS, np.uint64), np.zeros(CELLS, np.int64)
    for key in _keys(indices, held):
        tier, index = key >> _INDEX_BITS, key & ((1 << _INDEX_BITS) - 1)
        row = out_table[pages]
        row[0], row[1], row[2], row[4] = tier, index, used, filled
        sources, source = 0, 0
        for p in range(len(table)):
            if held[p, tier] and indices[p, tier] == index:
                sources, source = sources + 1, p
        if sources == 1 and not spread[source]:
            used = _copy(votes, table[source, 2], table[source, 3], out_votes, used)
            filled = _copy(cells, table[source, 4], table[source, 5], out_cells, filled)
        else:
            for p in range(len(table)):
                if held[p, tier] and indices[p, tier] == index:
                    every = not spread[p]
                    _add(table[p], tier, tiers, votes, cells, wanted, counts, planes, visits, machines, newest, every)
            used = _emit_votes(counts, planes, newest, out_votes, used)
            filled = _emit_cells(visits, machines, newest, out_cells, filled)
        row[3], row[5] = used, filled
        pages += 1
    return pages


@numba.njit(cache=True, nogil=True)
def _add(
    page: Any, tier: int, tiers: Any, votes: Any, cells: Any, wanted: Any,
    counts: Any, planes: Any, visits: Any, machines: Any, newest: Any, all_wanted: Any,
) -> None:  # fmt: skip
    """Add a page's cells of one tier, and their votes; all_wanted: these are all of its cells."""
    for j in range(np.uint64(page[4]), np.uint64(page[5])):
        cell = np.uint64(cells[j].cell)
        wanted[cell] = tiers[j] == tier
        if tiers[j] == tier:
            visits[cell] |= cells[j].visits
            machines[cell] |= cells[j].machines
            newest[cell] = max(newest[cell], cells[j].newest_ns)
    if all_wanted:
        for j in range(np.uint64(page[2]), np.uint64(page[3])):
            place = votes[j] & np.uint64(0xFFFF)
            counts[place] += votes[j] >> np.uint64(16)
            planes[place >> np.uint64(8)] = True
    else:
        for j in range(np.uint64(page[2]), np.uint64(page[3])):
            place = votes[j] & np.uint64(0xFFFF)
            if wanted[place & np.uint64(CELLS - 1)]:
                counts[place] += votes[j] >> np.uint64(16)
                planes[place >> np.uint64(8)] = True


@numba.njit(cache=True, nogil=True)
def _indices(table: Any, spans: Any) -> Any:
    """Index (n, tiers) of each page's span by tier, -1 on finer tiers than its own."""
    indices = np.full((len(table), len(spans)), -1, np.int64)
    for p in range(len(table)):
        tier = table[p, 0]
        indices[p, tier] = table[p, 1]
        for coarser in range(tier + 1, len(spans)):
            span = spans[coarser]
            indices[p, coarser] = indices[p, coarser - 1] * spans[coarser - 1] // span if span else 0
    return indices


@numba.njit(cache=True, nogil=True)
def _find_tiers(table: Any, indices: Any, cells: Any, keeps: Any, tiers: Any) -> None:
    """Tier of each page's cells: beyond a tier's newest spans, cells move to the next."""
    for p in range(len(table)):
        tiers[table[p, 4] : table[p, 5]] = table[p, 0]
    kept, last = np.empty(CELLS, np.int64), np.empty(CELLS, np.int64)
    for tier in range(len(keeps) - 1):
        kept[:], last[:] = 0, -1
        for p in _newest_first(indices, tier):
            index = indices[p, tier]
            if index < 0:
                break
            for j in range(np.uint64(table[p, 4]), np.uint64(table[p, 5])):
                if tiers[j] == tier:
                    cell = np.uint64(cells[j].cell)
                    if last[cell] != index:
                        last[cell] = index
                        kept[cell] += 1
                    if kept[cell] > keeps[tier]:
                        tiers[j] = tier + 1


# Pages are few and mostly in order: insertion is quick, and numba's own sorts take seconds to compile.


@numba.njit(cache=True, nogil=True)
def _newest_first(indices: Any, tier: int) -> Any:
    """Pages (n,) by falling index on a tier."""
    order = np.empty(len(indices), np.int64)
    for p in range(len(indices)):
        at = p
        while at and indices[order[at - 1], tier] < indices[p, tier]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = p
    return order


@numba.njit(cache=True, nogil=True)
def _held(table: Any, tiers: Any, count: int) -> Any:
    """Which tiers each page has cells on (n, count), and whether on several (n,)."""
    held, spread = np.zeros((len(table), count), np.bool_), np.zeros(len(table), np.bool_)
    for p in range(len(table)):
        for j in range(np.uint64(table[p, 4]), np.uint64(table[p, 5])):
            held[p, np.uint8(tiers[j])] = True
        on = 0
        for tier in range(count):
            on += held[p, tier]
        spread[p] = on > 1
    return held, spread


@numba.njit(cache=True, nogil=True)
def _keys(indices: Any, held: Any) -> Any:
    """Tier and index of the resulting pages, sorted."""
    keys, used = np.empty(held.size, np.int64), 0
    for p in range(len(held)):
        for tier in range(held.shape[1]):
            if held[p, tier]:
                key = (np.int64(tier) << _INDEX_BITS) | indices[p, tier]
                at = used
                while at and keys[at - 1] > key:
                    at -= 1
                if not at or keys[at - 1] != key:
                    for later in range(used, at, -1):
                        keys[later] = keys[later - 1]
                    keys[at], used = key, used + 1
    return keys[:used]


@numba.njit(cache=True, nogil=True)
def _copy(source: Any, first: int, end: int, out: Any, used: int) -> int:
    source_at, at = np.uint64(first), np.uint64(used)
    for i in range(np.uint64(end - first)):
        out[at + i] = source[source_at + i]
    return used + end - first


@numba.njit(cache=True, nogil=True)
def _emit_votes(counts: Any, planes: Any, newest: Any, out: Any, used: int) -> Any:
    """Move counts to votes by place, saturated; returns their end."""
    low, high = 0, CELLS
    while not newest[low]:
        low += 1
    while not newest[high - 1]:
        high -= 1
    end = np.uint64(used)
    most = np.uint64(COUNT_MAX)
    for plane in range(COUNTS):
        if planes[plane]:
            planes[plane] = False
            for at in range(np.uint64(plane * CELLS + low), np.uint64(plane * CELLS + high)):
                count = min(counts[at], most)
                out[end] = (count << np.uint64(16)) | at
                end += np.uint64(count != 0)
            counts[plane * CELLS + low : plane * CELLS + high] = 0
    return np.int64(end)


@numba.njit(cache=True, nogil=True)
def _emit_cells(visits: Any, machines: Any, newest: Any, out: Any, used: int) -> int:
    """Move bitmaps and stamps to cells by number; returns their end."""
    for i in range(CELLS):
        if newest[i]:
            out[used].cell, out[used].newest_ns = i, newest[i]
            out[used].visits, out[used].machines = visits[i], machines[i]
            visits[i] = machines[i] = newest[i] = 0
            used += 1
    return used
