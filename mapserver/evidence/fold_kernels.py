"""Sorted samples to packed pages (compiled); each block and bucket is folded once.

A scratch block, laid out by bin, sums evidence: samples add rows of 16 cells, 64 bytes, which compilers vectorise. Then
it is packed. A packed vote has its place (bin * 256 + cell) in the lower 16 of 64 bits, its count above.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev

_RESISTANCE, _EAST, _NORTH = ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start
_HEADING, _DOUBT, _AIDED, _COUNTS, _CELLS = ev.HEADING.start, ev.DOUBT, ev.AIDED, ev.COUNTS, ev.CELLS
_ZERO = ev.ZERO
_ONE, _PLANE, _HALF_SHARE = np.uint64(1), np.uint64(ev.CELLS), np.uint32(ev.SHARE_ONE // 2)
_NONE = np.uint32(0)

# Block column, block row, bucket. 18, 18 and 27 bits allow 5 cm cells 100 km away, and minutes until 2100.
BLOCK_BITS, BUCKET_BITS = 18, 27
HALF = 1 << (BLOCK_BITS - 1)
_BLOCK_MASK, _BUCKET_MASK = (1 << BLOCK_BITS) - 1, (1 << BUCKET_BITS) - 1


@numba.njit(cache=True, nogil=True)
def fold_sorted(
    first: int, keys: Any, touching: Any, samples: Any, scratch: Any, out_pages: Any, out_votes: Any, out_cells: Any
) -> tuple[int, int, int, int]:
    """Fold sorted pairs from number `first`, a page per key.

    keys, touching: of `locate`, sorted. samples: (stencils of `locate`, starts and shares of `weigh`, bins, shares,
    bits and stamps of `split`). scratch: (counts (COUNTS * 256,) uint32, lines (COUNTS,) int32 with a bit per row of
    cells, visits, machines (256,) uint64, newest (256,) int64), zero before and after. Fills pages (m, 8): block, then
    as Pages.table with the bucket as index; votes; cells. Stops when full. Returns the next pair and counts of pages,
    votes, cells.
    """
    stencils, starts, shares, bins, bin_shares, bits, stamps = samples
    counts, lines, visits, machines, newest = scratch
    lane, last = np.empty(_CELLS, np.uint32), np.zeros(_CELLS, np.uint32)
    pages, votes, cells, at = 0, _ZERO, _ZERO, first
    while (
        at < len(keys)
        and pages < len(out_pages)
        and votes + _COUNTS * _CELLS <= len(out_votes)
        and cells + _CELLS <= len(out_cells)
    ):
        key = keys[at]
        left = ((key >> (BLOCK_BITS + BUCKET_BITS)) - HALF) << 4
        bottom = (((key >> BUCKET_BITS) & _BLOCK_MASK) - HALF) << 4
        low, high = 16, 0  # touched rows of cells
        run_low, run_high = _ZERO + 16, _ZERO  # of a run: one machine and minute, by stamp
        before = -1
        while at < len(keys) and keys[at] == key:
            k = touching[at]
            at += 1
            first_x, first_y, n = stencils[k, 0], stencils[k, 1], stencils[k, 2]
            x, end_x = max(first_x, left), min(first_x + n, left + 16)
            y, end_y = max(first_y, bottom), min(first_y + n, bottom + 16)
            part = lane[: (end_y - y) * 16]
            _lay_out(shares, starts[k] + (y - first_y) * n + x - first_x, n, end_x - x, x - left, part)
            top, end = y - bottom, end_y - bottom
            low, high = min(low, top), max(high, end)
            _vote(counts, lines, top, end, part, bins, bin_shares, k)
            if before >= 0 and not (
                bits[before, 0] == bits[k, 0] and bits[before, 1] == bits[k, 1] and stamps[before] <= stamps[k]
            ):
                _mark(bits, stamps, last, run_low, run_high, visits, machines, newest)
                run_low, run_high = 16, 0
            run_low, run_high, before = min(run_low, top), max(run_high, end), k
            _touch(last, top, part, np.uint32(k + 1))
        _mark(bits, stamps, last, run_low, run_high, visits, machines, newest)
        end_votes = _pack_votes(counts, lines, low, high, out_votes, votes)
        end_cells = _pack_cells(visits, machines, newest, low, high, out_cells, cells)
        if end_cells > cells:
            page = out_pages[pages]
            page[0], page[1], page[2], page[3] = left >> 4, bottom >> 4, 0, key & _BUCKET_MASK
            page[4], page[5], page[6], page[7] = votes, end_votes, cells, end_cells
            pages += 1
        votes, cells = end_votes, end_cells
    return at, pages, votes, cells


@numba.njit(cache=True, nogil=True)
def _lay_out(shares: Any, first: int, edge: int, width: int, column: int, lane: Any) -> None:
    """Copy a stencil's lines inside a block into rows of 16 cells."""
    lane[:] = 0
    source, target = np.uint64(first), np.uint64(column)
    for _ in range(len(lane) // 16):
        for i in range(np.uint64(width)):
            lane[target + i] = shares[source + i]
        source += np.uint64(edge)
        target += np.uint64(16)


# unsigned indices below avoid checks for negative ones


@numba.njit(cache=True, nogil=True)
def _vote(counts: Any, lines: Any, top: int, end: int, part: Any, bins: Any, bin_shares: Any, k: int) -> None:
    """Add a sample's votes to rows of cells top <= row < end."""
    touched = np.int32((1 << end) - (1 << top))
    first, n = np.uint64(top * 16), np.uint64(len(part))
    for value in range(3):
        if bins[k, value] >= 0:
            plane = np.uint64(bins[k, value] + (_RESISTANCE if value == 0 else _EAST if value == 1 else _NORTH))
            lower = plane * _PLANE + first
            upper = lower + _PLANE
            share = bin_shares[k, value]
            for i in range(n):
                above = np.uint32(np.uint32(part[i] * share) >> np.uint32(8))
                counts[lower + i] += np.uint32(part[i] - above)
                counts[upper + i] += above
            lines[plane] |= touched
            lines[plane + _ONE] |= touched
    for line, share in ((_DOUBT, bin_shares[k, 3] if bins[k, 0] >= 0 else _NONE), (_AIDED, bin_shares[k, 4])):
        if share:
            at = np.uint64(line) * _PLANE + first
            for i in range(n):
                counts[at + i] += np.uint32(np.uint32(part[i] * share + _HALF_SHARE) >> np.uint32(8))
            lines[line] |= touched
    sector = np.uint64(_HEADING + bins[k, 3])
    at = sector * _PLANE + first
    for i in range(n):
        counts[at + i] += part[i]
    lines[sector] |= touched


@numba.njit(cache=True, nogil=True)
def _touch(last: Any, top: int, part: Any, number: Any) -> None:
    """Note the last sample that touched each cell."""
    at = np.uint64(top * 16)
    for i in range(np.uint64(len(part))):
        last[at + i] = number if part[i] else last[at + i]


@numba.njit(cache=True, nogil=True)
def _mark(bits: Any, stamps: Any, last: Any, low: int, high: int, visits: Any, machines: Any, newest: Any) -> None:
    """Set bits and newest stamp of a run's cells, and clear the run."""
    for i in range(np.uint64(low * 16), np.uint64(high * 16)):
        if last[i]:
            k = np.uint64(last[i]) - _ONE
            visits[i] |= bits[k, np.uint64(0)]
            machines[i] |= bits[k, _ONE]
            newest[i] = max(newest[i], stamps[k])
            last[i] = 0


@numba.njit(cache=True, nogil=True)
def _pack_votes(counts: Any, lines: Any, low: int, high: int, out: Any, used: int) -> Any:
    """Move counts to votes; returns their end."""
    end = np.uint64(used)
    for plane in range(_COUNTS):
        touched = lines[plane]
        if not touched:
            continue
        lines[plane] = 0
        for line in range(low, high):
            if touched >> line & 1:
                at = np.uint64(plane * _CELLS + line * 16)
                for i in range(np.uint64(16)):
                    count = counts[at + i]
                    out[end] = (np.uint64(count) << np.uint64(16)) | (at + i)
                    end += np.uint64(count != 0)
                counts[at : at + np.uint64(16)] = 0
    return np.int64(end)


@numba.njit(cache=True, nogil=True)
def _pack_cells(visits: Any, machines: Any, newest: Any, low: int, high: int, out: Any, used: int) -> int:
    """Move bitmaps and stamps to cells; returns their end."""
    for i in range(low * 16, high * 16):
        if newest[i]:
            out[used].cell, out[used].newest_ns = i, newest[i]
            out[used].visits, out[used].machines = visits[i], machines[i]
            visits[i] = machines[i] = newest[i] = 0
            used += 1
    return used
