"""Samples into packed pages, compiled: locate them, sort them by block and time bucket, fold each of these once.

Evidence of one block over one bucket is summed in a scratch block, which lies in memory bin by bin, so that a sample
adds whole rows of 16 neighbouring cells to each bin that it votes for: additions of 64 bytes, which the compiler turns
into vector instructions. The scratch block is packed into a page before the next block begins.

A vote is packed in 64 bits: its place (bin * 256 + cell) in the lower 16, its count above them.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.votes import (
    GRADE_LOW,
    GRADE_STEPS,
    HASH,
    RESISTANCE_STEPS,
    TABLE,
    TABLE_LAST,
    TABLE_PER_UNIT,
    VISIT_NS,
    WEIGHT_SHIFT,
)

_RESISTANCE, _EAST, _NORTH = ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start
_HEADING, _COUNTS, _CELLS = ev.HEADING.start, ev.COUNTS, ev.CELLS
_R_LAST, _G_LAST = ev.RESISTANCE_BINS - 2, ev.GRADE_BINS - 2
_R_PER_LOG = len(RESISTANCE_STEPS) / np.log(ev.RESISTANCE_CENTRES[-1] / ev.RESISTANCE_CENTRES[0])
_R_OFFSET = 0.5 - np.log(ev.RESISTANCE_CENTRES[0]) * _R_PER_LOG
_G_TOP = (ev.GRADE_BINS - 1) * ev.SHARE_ONE
_SECTOR_RAD, _SECTORS = 2 * np.pi / ev.SECTORS, ev.SECTORS
_UNITS, _ONE = ev.WEIGHT_UNITS_PER_M, ev.SHARE_ONE
_HASH = np.uint64(HASH)
_TABLE = TABLE.astype(np.uint32)

# Keys sort by block column, block row and bucket: 18, 18 and 27 bits, enough for 5 cm cells 100 km away, and for
# minutes until the year 2100.
_BLOCK_BITS, _BUCKET_BITS = 18, 27
_HALF = 1 << (_BLOCK_BITS - 1)
_BLOCK_MASK, _BUCKET_MASK = (1 << _BLOCK_BITS) - 1, (1 << _BUCKET_BITS) - 1


@numba.njit(cache=True, nogil=True)
def locate(
    rows: Any, limits: tuple[float, float, float], bucket_ns: int, places: Any, stencils: Any
) -> tuple[Any, Any, int]:
    """Where rows lie, and which blocks their stencils touch.

    limits: cell size [m], variance added to every position, largest variance of one that votes [m2]. Fills places
    (n, 5): position in cells, inverse covariance xx, 2 xy, yy; and stencils (n, 3): first column and row, and edge in
    cells, 0 where a row has no vote. Returns keys and row numbers, one each for every block that a row touches, and the
    cells of all stencils together.
    """
    keys, touching = np.empty(3 * len(rows) + 16, np.int64), np.empty(3 * len(rows) + 16, np.int32)
    used, area = 0, 0
    for k in range(len(rows)):
        reach = _place(rows[k], limits, places[k])
        stencils[k, 2] = n = 2 * reach + 1
        if reach < 0:
            stencils[k, 2] = 0
            continue
        area += n * n
        column = stencils[k, 0] = int(np.floor(places[k, 0])) - reach
        row = stencils[k, 1] = int(np.floor(places[k, 1])) - reach
        bucket = rows[k].stamp_ns // bucket_ns
        for y in range(row >> 4, ((row + n - 1) >> 4) + 1):
            for x in range(column >> 4, ((column + n - 1) >> 4) + 1):
                if used == len(keys):
                    keys = np.concatenate((keys, np.empty_like(keys)))
                    touching = np.concatenate((touching, np.empty_like(touching)))
                keys[used] = ((x + _HALF) << (_BLOCK_BITS + _BUCKET_BITS)) | ((y + _HALF) << _BUCKET_BITS) | bucket
                touching[used] = k
                used += 1
    return keys[:used], touching[:used], area


@numba.njit(cache=True, nogil=True)
def _place(row: Any, limits: tuple[float, float, float], out: Any) -> int:
    """Position and inverse covariance of one row in cells; returns its reach in cells, -1 where it has no vote."""
    cell_m, floor_m2, cap_m2 = limits
    cov_xx, cov_xy, cov_yy = np.float64(row.cov_xx_m2), np.float64(row.cov_xy_m2), np.float64(row.cov_yy_m2)
    half = (cov_xx - cov_yy) / 2
    if not (cov_xx + cov_yy) / 2 + np.sqrt(half * half + cov_xy * cov_xy) <= cap_m2:
        return -1
    per_m2 = 1 / (cell_m * cell_m)
    most = np.sqrt(cov_xx * cov_yy)
    xx, yy = (cov_xx + floor_m2) * per_m2, (cov_yy + floor_m2) * per_m2
    xy = min(max(cov_xy, -most), most) * per_m2  # what rounding lets pass must not make the covariance indefinite
    scale = 1 / (xx * yy - xy * xy)
    out[0], out[1] = row.x_m / cell_m, row.y_m / cell_m
    out[2], out[3], out[4] = yy * scale, -2 * xy * scale, xx * scale
    return int(np.ceil(2 * np.sqrt(max(xx, yy))))


@numba.njit(cache=True, nogil=True)
def weigh(rows: Any, places: Any, stencils: Any, starts: Any, shares: Any) -> None:
    """Spread the weight of each row over its stencil.

    Fills shares with the stencils (edge, edge), one behind the other from starts (n,) on. The integer shares of a row
    sum exactly to its weight: what rounding down leaves over goes to the middle.
    """
    used = 0
    for k in range(len(rows)):
        starts[k] = used
        n = stencils[k, 2]
        if not n:
            continue
        total = _weights(places[k], stencils[k], shares, used)
        weight = int(np.rint(np.float64(rows[k].distance_m) * _UNITS))
        factor = (weight << WEIGHT_SHIFT) // max(total, 1)
        rest: Any = weight
        stencil = shares[used:][: n * n]
        for i in range(n * n):
            share = (np.int64(stencil[i]) * factor) >> WEIGHT_SHIFT
            stencil[i] = share
            rest -= share
        stencil[n * n // 2] += np.uint32(rest)
        used += n * n


@numba.njit(cache=True, nogil=True)
def _weights(place: Any, stencil: Any, shares: Any, used: int) -> int:
    """Fill a stencil with weights from the table; returns their sum."""
    n = stencil[2]
    total = 0
    for dy in range(n):
        y = (stencil[1] + dy + 0.5) - place[1]
        b, c = place[3] * y, place[4] * y * y
        line = shares[used + dy * n :][:n]
        for dx in range(n):
            x = (stencil[0] + dx + 0.5) - place[0]
            d2 = (place[2] * x + b) * x + c
            weight = _TABLE[int(min(d2 * TABLE_PER_UNIT, TABLE_LAST))]
            line[dx] = weight
            total += int(weight)
    return total


@numba.njit(cache=True, nogil=True)
def split(rows: Any, names: Any, bins: Any, shares: Any, bits: Any, stamps: Any) -> None:
    """What rows vote for.

    names (n,): hashes of machines. Fills bins (n, 4): of resistance, grade east and grade north, -1 for no vote, and
    sector of the heading; shares (n, 3) of the bin above, in 1/256; bits (n, 2): one of the visit and one of the
    machine (a multiplicative hash takes the top six bits); stamps (n,).
    """
    for k in range(len(rows)):
        row = rows[k]
        bins[k, 0], shares[k, 0] = _split_resistance(np.float64(row.c_rr))
        bins[k, 1], shares[k, 1] = _split_grade(np.float64(row.grade_e))
        bins[k, 2], shares[k, 2] = _split_grade(np.float64(row.grade_n))
        bins[k, 3] = np.int64(np.floor(np.float64(row.heading_rad) / _SECTOR_RAD + 0.5)) % _SECTORS
        visit = (names[k] + np.uint64(row.stamp_ns // VISIT_NS)) * _HASH
        bits[k, 0], bits[k, 1] = np.uint64(1) << (visit >> np.uint64(58)), np.uint64(1) << (names[k] >> np.uint64(58))
        stamps[k] = row.stamp_ns


@numba.njit(cache=True, nogil=True)
def _split_resistance(c_rr: float) -> tuple[int, Any]:
    """Lower bin and share of the bin above it, linear in log(c_rr); beyond the ends, the end bins; -1 for unknown."""
    if np.isnan(c_rr):
        return -1, np.uint32(0)
    place = int(min(max(np.log(max(c_rr, 1e-9)) * _R_PER_LOG + _R_OFFSET, 0.0), len(RESISTANCE_STEPS)))  # nearly
    while place < len(RESISTANCE_STEPS) and RESISTANCE_STEPS[place] <= c_rr:
        place += 1
    while place > 0 and RESISTANCE_STEPS[place - 1] > c_rr:
        place -= 1
    lower = min(place // _ONE, _R_LAST)
    return lower, np.uint32(place - lower * _ONE)


@numba.njit(cache=True, nogil=True)
def _split_grade(grade: float) -> tuple[int, Any]:
    """Lower bin and share of the bin above it; beyond the ends, the end bins; -1 for unknown."""
    if np.isnan(grade):
        return -1, np.uint32(0)
    place = int(min(max(np.rint((grade - GRADE_LOW) * GRADE_STEPS), 0), _G_TOP))
    lower = min(place // _ONE, _G_LAST)
    return lower, np.uint32(place - lower * _ONE)


@numba.njit(cache=True, nogil=True)
def fold_sorted(
    first: int, keys: Any, touching: Any, samples: Any, scratch: Any, out_pages: Any, out_votes: Any, out_cells: Any
) -> tuple[int, int, int, int]:
    """Fold sorted pairs from number `first` on, one page for each key.

    keys, touching: as of `locate`, sorted by key. samples: (stencils of `locate`, starts and shares of `weigh`, bins,
    shares, bits and stamps of `split`). scratch: (counts (COUNTS * 256,) uint32, lines (COUNTS,) int32 one bit for each
    row of 16 cells, visits, machines (256,) uint64, newest (256,) int64), zero before and after.
    Fills pages (m, 7): block column and row, bucket, first and end of its votes and of its cells; votes; cells CELL.
    Stops where another page might not fit. Returns the number of the next pair, and how many pages, votes and cells
    were written.
    """
    stencils, starts, shares, bins, bin_shares, bits, stamps = samples
    counts, lines, visits, machines, newest = scratch
    lane, last = np.empty(_CELLS, np.uint32), np.zeros(_CELLS, np.uint32)
    pages, votes, cells, at = 0, 0, 0, first
    while (
        at < len(keys)
        and pages < len(out_pages)
        and votes + _COUNTS * _CELLS <= len(out_votes)
        and cells + _CELLS <= len(out_cells)
    ):
        key = keys[at]
        left = ((key >> (_BLOCK_BITS + _BUCKET_BITS)) - _HALF) << 4
        bottom = (((key >> _BUCKET_BITS) & _BLOCK_MASK) - _HALF) << 4
        low, high = 16, 0  # rows of cells that were touched
        run_low, run_high = 16, 0  # and those of a run: rows of one machine and minute, in the order of their stamps
        before = -1
        while at < len(keys) and keys[at] == key:
            k = touching[at]
            at += 1
            first_x, first_y, n = stencils[k, 0], stencils[k, 1], stencils[k, 2]
            x, end_x = max(first_x, left), min(first_x + n, left + 16)
            y, end_y = max(first_y, bottom), min(first_y + n, bottom + 16)
            part = lane[: (end_y - y) * 16]
            part[:] = 0
            source = np.uint64(starts[k] + (y - first_y) * n + x - first_x)
            target = np.uint64(x - left)
            for _ in range(end_y - y):
                for i in range(np.uint64(end_x - x)):
                    lane[target + i] = shares[source + i]
                source += np.uint64(n)
                target += np.uint64(16)
            top, end = y - bottom, end_y - bottom
            low, high = min(low, top), max(high, end)
            _vote_all(counts, lines, top, end, part, bins, bin_shares, k)
            if before >= 0 and not (
                bits[before, 0] == bits[k, 0] and bits[before, 1] == bits[k, 1] and stamps[before] <= stamps[k]
            ):
                _mark(bits, stamps, last, run_low, run_high, visits, machines, newest)
                run_low, run_high = 16, 0
            run_low, run_high, before = min(run_low, top), max(run_high, end), k
            _touch(last, top * 16, part, np.uint32(k + 1))
        _mark(bits, stamps, last, run_low, run_high, visits, machines, newest)
        end_votes = _pack_votes(counts, lines, low, high, out_votes, votes)
        end_cells = _pack_cells(visits, machines, newest, low, high, out_cells, cells)
        if end_cells > cells:
            page = out_pages[pages]
            page[0], page[1], page[2] = left >> 4, bottom >> 4, key & _BUCKET_MASK
            page[3], page[4], page[5], page[6] = votes, end_votes, cells, end_cells
            pages += 1
        votes, cells = end_votes, end_cells
    return at, pages, votes, cells


@numba.njit(cache=True, nogil=True)
def _vote_all(counts: Any, lines: Any, top: int, end: int, part: Any, bins: Any, bin_shares: Any, k: int) -> None:
    """Add the votes of one row for some rows of cells, top <= row < end."""
    touched = np.int32((1 << end) - (1 << top))
    for value in range(3):
        if bins[k, value] >= 0:
            plane = bins[k, value] + (_RESISTANCE if value == 0 else _EAST if value == 1 else _NORTH)
            _vote(counts, plane * _CELLS + top * 16, part, bin_shares[k, value])
            lines[plane] |= touched
            lines[plane + 1] |= touched
    sector = _HEADING + bins[k, 3]
    _add(counts, sector * _CELLS + top * 16, part)
    lines[sector] |= touched


# The loops below run over slices from 0 on: the compiler sees that no index is negative, and vectorises.


@numba.njit(cache=True, nogil=True)
def _vote(counts: Any, at: int, lane: Any, share: Any) -> None:
    lower, upper = counts[at:][: len(lane)], counts[at + _CELLS :][: len(lane)]
    for i in range(len(lane)):
        above = np.uint32(np.uint32(lane[i] * share) >> np.uint32(8))
        lower[i] += np.uint32(lane[i] - above)
        upper[i] += above


@numba.njit(cache=True, nogil=True)
def _add(counts: Any, at: int, lane: Any) -> None:
    cells = counts[at:][: len(lane)]
    for i in range(len(lane)):
        cells[i] += lane[i]


@numba.njit(cache=True, nogil=True)
def _touch(last: Any, at: int, lane: Any, number: Any) -> None:
    """Note the number of the row that touched cells last."""
    cells = last[at:][: len(lane)]
    for i in range(len(lane)):
        cells[i] = number if lane[i] else cells[i]


@numba.njit(cache=True, nogil=True)
def _mark(bits: Any, stamps: Any, last: Any, low: int, high: int, visits: Any, machines: Any, newest: Any) -> None:
    """Set the bits and the newest stamp of the cells that a run touched, and forget the run."""
    for i in range(low * 16, high * 16):
        if last[i]:
            k = last[i] - 1
            visits[i] |= bits[k, 0]
            machines[i] |= bits[k, 1]
            newest[i] = max(newest[i], stamps[k])
            last[i] = 0


@numba.njit(cache=True, nogil=True)
def _pack_votes(counts: Any, lines: Any, low: int, high: int, out: Any, used: int) -> int:
    """Move what is not zero in the scratch block to votes; returns where they end."""
    for plane in range(_COUNTS):
        touched = lines[plane]
        if not touched:
            continue
        lines[plane] = 0
        for line in range(low, high):
            if touched >> line & 1:
                at = plane * _CELLS + line * 16
                cells = counts[at:][:16]
                for i in range(16):
                    out[used] = (np.uint64(cells[i]) << np.uint64(16)) | np.uint64(at + i)
                    used += 1 if cells[i] else 0
                    cells[i] = 0
    return used


@numba.njit(cache=True, nogil=True)
def _pack_cells(visits: Any, machines: Any, newest: Any, low: int, high: int, out: Any, used: int) -> int:
    """Move bitmaps and stamps of touched cells to cells; returns where they end."""
    for i in range(low * 16, high * 16):
        if newest[i]:
            out[used].cell, out[used].newest_ns = i, newest[i]
            out[used].visits, out[used].machines = visits[i], machines[i]
            visits[i] = machines[i] = newest[i] = 0
            used += 1
    return used
