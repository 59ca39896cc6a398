"""The fold: every sample votes, with integer weights that sum exactly to its own, in the cells around its place.

Compiled by numba. Blocks lie in memory bin by bin, so that one sample adds whole rows of 16 neighbouring cells to each
bin that it votes for: additions of 64 bytes, which the compiler turns into vector instructions. Shares are first laid
out in such rows ("lanes"), one block column after the other. tests/reference/fold.py computes the same bits in numpy.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.open_blocks import CODE_BITS, CODE_HALF, FREE, OpenBlocks
from mapserver.evidence.votes import (
    GRADE_LOW,
    GRADE_STEPS,
    HASH,
    RESISTANCE_STEPS,
    STD_FLOOR_M,
    TABLE,
    TABLE_LAST,
    TABLE_PER_UNIT,
    VISIT_NS,
    WEIGHT_SHIFT,
    FoldConfig,
    name_hash,
)
from protocol.arrays import Table

_RESISTANCE, _EAST, _NORTH = ev.RESISTANCE.start, ev.GRADE_EAST.start, ev.GRADE_NORTH.start
_HEADING, _COUNTS, _CELLS = ev.HEADING.start, ev.COUNTS, ev.CELLS
_R_LAST, _G_LAST = ev.RESISTANCE_BINS - 2, ev.GRADE_BINS - 2
_R_PER_LOG = len(RESISTANCE_STEPS) / np.log(ev.RESISTANCE_CENTRES[-1] / ev.RESISTANCE_CENTRES[0])
_R_OFFSET = 0.5 - np.log(ev.RESISTANCE_CENTRES[0]) * _R_PER_LOG
_G_TOP = (ev.GRADE_BINS - 1) * ev.SHARE_ONE
_SECTOR_RAD, _SECTORS = 2 * np.pi / ev.SECTORS, ev.SECTORS
_UNITS, _ONE = ev.WEIGHT_UNITS_PER_M, ev.SHARE_ONE
_HASH = np.uint64(HASH)


def fold(rows: Table, machine: str, cell_m: float, config: FoldConfig, blocks: OpenBlocks) -> int:
    """Add samples of one machine to open blocks, and open those that it needs; returns how many samples voted.

    Samples whose position is less certain than `config.std_cap_m` do not vote. Raises NoRoom where more blocks would
    have to be opened than there is room for: nothing was folded then.
    """
    limits = (cell_m, STD_FLOOR_M**2, config.std_cap_m**2)
    places, slots, folded, gaps = _locate(rows, limits, config.bucket_ns, blocks.keys, blocks.places, blocks.shift)
    if len(gaps):
        blocks.open(dict.fromkeys(gaps[:, 1].tolist()))
        _fill(slots, gaps, blocks.keys, blocks.places, blocks.shift)
    arrays = (blocks.counts.reshape(-1), blocks.planes, blocks.bitmaps.reshape(-1), blocks.newest.reshape(-1))
    _fold(rows, places, slots, np.uint64(name_hash(machine)), *arrays)
    return int(folded)


@numba.njit(cache=True, nogil=True)
def _locate(
    rows: Any, limits: tuple[float, float, float], bucket_ns: int, keys: Any, places: Any, shift: int
) -> tuple[Any, Any, int, Any]:
    """Locate each row, and look up the slots of all blocks that its stencil touches, row by row.

    limits: size of a cell [m], floor and cap of a position's variance [m2]. Returns places (n, 6): position in cells,
    inverse covariance xx, 2 xy, yy, and reach, -1 where a row has no vote; the slots; how many rows vote; and gaps
    (m, 2): index in slots and code of each block that is not open.
    """
    n = len(rows)
    where = np.empty((n, 6))
    slots = np.empty(4 * n, np.int64)
    gaps = np.empty((16, 2), np.int64)
    used, folded, missing = 0, 0, 0
    for k in range(n):
        _place(rows[k], limits, where[k])
        if where[k, 5] < 0:
            continue
        folded += 1
        reach = int(where[k, 5])
        column, row = int(np.floor(where[k, 0])), int(np.floor(where[k, 1]))
        bucket = rows[k].stamp_ns // bucket_ns
        for y in range((row - reach) >> 4, ((row + reach) >> 4) + 1):
            for x in range((column - reach) >> 4, ((column + reach) >> 4) + 1):
                code = (bucket << 2 * CODE_BITS) | ((x + CODE_HALF) << CODE_BITS) | (y + CODE_HALF)
                slot = _find(keys, places, shift, code)
                if slot == FREE:
                    if missing == len(gaps):
                        gaps = np.concatenate((gaps, np.empty_like(gaps)))
                    gaps[missing, 0], gaps[missing, 1] = used, code
                    missing += 1
                if used == len(slots):
                    slots = np.concatenate((slots, np.empty_like(slots)))
                slots[used] = slot
                used += 1
    return where, slots, folded, gaps[:missing]


@numba.njit(cache=True, nogil=True)
def _fill(slots: Any, gaps: Any, keys: Any, places: Any, shift: int) -> None:
    """Fill in the slots of `gaps`, whose blocks are open now."""
    for i in range(len(gaps)):
        slots[gaps[i, 0]] = _find(keys, places, shift, gaps[i, 1])


@numba.njit(cache=True, nogil=True)
def _find(keys: Any, places: Any, shift: int, code: int) -> int:
    """Slot of a code in the hash table of OpenBlocks, FREE if it has none."""
    mask = len(keys) - 1
    entry = np.int64((np.uint64(code) * _HASH) >> np.uint64(shift))
    while keys[entry] != FREE:
        if keys[entry] == code:
            return places[entry]  # type: ignore[no-any-return]
        entry = (entry + 1) & mask
    return FREE


@numba.njit(cache=True, nogil=True)
def _place(row: Any, limits: tuple[float, float, float], out: Any) -> None:
    """Position in cells, inverse covariance and reach of one row, as in `_locate`.

    Correlations are clipped: rows are checked in single precision, and what rounding lets pass must not make the
    covariance indefinite.
    """
    cell_m, floor_m2, cap_m2 = limits
    cov_xx, cov_xy, cov_yy = np.float64(row.cov_xx_m2), np.float64(row.cov_xy_m2), np.float64(row.cov_yy_m2)
    half = (cov_xx - cov_yy) / 2
    if not (cov_xx + cov_yy) / 2 + np.sqrt(half * half + cov_xy * cov_xy) <= cap_m2:
        out[5] = -1.0
        return
    per_m2 = 1 / (cell_m * cell_m)
    most = np.sqrt(cov_xx * cov_yy)
    xx, yy = (cov_xx + floor_m2) * per_m2, (cov_yy + floor_m2) * per_m2
    xy = min(max(cov_xy, -most), most) * per_m2
    scale = 1 / (xx * yy - xy * xy)
    out[0], out[1] = row.x_m / cell_m, row.y_m / cell_m
    out[2], out[3], out[4] = yy * scale, -2 * xy * scale, xx * scale
    out[5] = np.ceil(2 * np.sqrt(max(xx, yy)))


@numba.njit(cache=True, nogil=True)
def _fold(rows: Any, places: Any, slots: Any, name: Any, counts: Any, planes: Any, bitmaps: Any, newest: Any) -> None:
    """Add the votes of all rows to the blocks in `slots`; name: hash of the machine's name."""
    edge = 2 * int(max(0.0, places[:, 5].max())) + 1 if len(rows) else 1
    raw = np.empty(edge * edge, np.int64)
    lanes = np.empty((edge // 16 + 2) * edge * 16, np.uint32)
    machine_bit = np.uint64(1) << (name >> np.uint64(58))
    used = 0
    for k in range(len(rows)):
        reach = int(places[k, 5])
        if reach < 0:
            continue
        row = rows[k]
        n = 2 * reach + 1
        first_x, first_y = int(np.floor(places[k, 0])) - reach, int(np.floor(places[k, 1])) - reach
        across = ((first_x + n - 1) >> 4) - (first_x >> 4) + 1
        weight = int(np.rint(np.float64(row.distance_m) * _UNITS))
        total = _weigh(places[k], first_x, first_y, n, raw)
        _spread(raw, n, total, weight, first_x & 15, lanes[: across * n * 16])
        resistance, resistance_share = _split_resistance(np.float64(row.c_rr))
        east, east_share = _split_grade(np.float64(row.grade_e))
        north, north_share = _split_grade(np.float64(row.grade_n))
        sector = np.int64(np.floor(np.float64(row.heading_rad) / _SECTOR_RAD + 0.5)) % _SECTORS
        visit = (name + np.uint64(row.stamp_ns // VISIT_NS)) * _HASH
        visit_bit = np.uint64(1) << (visit >> np.uint64(58))
        for y in range(first_y >> 4, ((first_y + n - 1) >> 4) + 1):
            top, end = max(first_y, y << 4), min(first_y + n, (y + 1) << 4)
            offset, size = (top & 15) * 16, (end - top) * 16
            for x in range(across):
                lane = lanes[(x * n + top - first_y) * 16 :][:size]
                at = slots[used] * (_COUNTS * _CELLS) + offset
                written = planes[slots[used]]
                if resistance >= 0:
                    _vote(counts, at + (_RESISTANCE + resistance) * _CELLS, lane, resistance_share)
                    written[_RESISTANCE + resistance] = written[_RESISTANCE + resistance + 1] = True
                if east >= 0:
                    _vote(counts, at + (_EAST + east) * _CELLS, lane, east_share)
                    written[_EAST + east] = written[_EAST + east + 1] = True
                if north >= 0:
                    _vote(counts, at + (_NORTH + north) * _CELLS, lane, north_share)
                    written[_NORTH + north] = written[_NORTH + north + 1] = True
                _add(counts, at + (_HEADING + sector) * _CELLS, lane)
                written[_HEADING + sector] = True
                _mark(bitmaps, slots[used] * 2 * _CELLS + offset, lane, visit_bit, machine_bit)
                _stamp(newest, slots[used] * _CELLS + offset, lane, row.stamp_ns)
                used += 1


@numba.njit(cache=True, nogil=True)
def _weigh(place: Any, first_x: int, first_y: int, n: int, raw: Any) -> int:
    """Fill raw[: n * n] with table weights; return their sum."""
    total = 0
    for dy in range(n):
        y = (first_y + dy + 0.5) - place[1]
        b, c = place[3] * y, place[4] * y * y
        line = raw[dy * n : dy * n + n]
        for dx in range(n):
            x = (first_x + dx + 0.5) - place[0]
            d2 = (place[2] * x + b) * x + c
            weight = TABLE[int(min(d2 * TABLE_PER_UNIT, TABLE_LAST))]
            line[dx] = weight
            total += weight
    return total


@numba.njit(cache=True, nogil=True)
def _spread(raw: Any, n: int, total: int, weight: int, column: int, lanes: Any) -> None:
    """Share a weight by raw[: n * n] into lanes (block columns, n, 16); what is left over goes to the middle."""
    factor = (weight << WEIGHT_SHIFT) // max(total, 1)
    rest = weight
    lanes[:] = 0
    for dy in range(n):
        line = raw[dy * n : dy * n + n]
        for dx in range(n):
            share = (line[dx] * factor) >> WEIGHT_SHIFT
            rest -= share
            lanes[(((column + dx) >> 4) * n + dy) * 16 + ((column + dx) & 15)] = share
    middle = column + n // 2
    lanes[((middle >> 4) * n + n // 2) * 16 + (middle & 15)] += np.uint32(rest)


@numba.njit(cache=True, nogil=True)
def _split_resistance(c_rr: float) -> tuple[int, Any]:
    """Lower bin and share (of SHARE_ONE) of the bin above, linear in log(c_rr); -1 for NaN; the ends take the rest."""
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
    """Lower bin and share (of SHARE_ONE) of the bin above; -1 for NaN; the ends take the rest."""
    if np.isnan(grade):
        return -1, np.uint32(0)
    place = int(min(max(np.rint((grade - GRADE_LOW) * GRADE_STEPS), 0), _G_TOP))
    lower = min(place // _ONE, _G_LAST)
    return lower, np.uint32(place - lower * _ONE)


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
def _mark(bitmaps: Any, at: int, lane: Any, visit_bit: Any, machine_bit: Any) -> None:
    visits, machines = bitmaps[at:][: len(lane)], bitmaps[at + _CELLS :][: len(lane)]
    nothing = np.uint64(0)
    for i in range(len(lane)):
        visits[i] |= visit_bit if lane[i] else nothing
        machines[i] |= machine_bit if lane[i] else nothing


@numba.njit(cache=True, nogil=True)
def _stamp(newest: Any, at: int, lane: Any, stamp_ns: int) -> None:
    cells = newest[at:][: len(lane)]
    for i in range(len(lane)):
        cells[i] = max(cells[i], stamp_ns if lane[i] else 0)
