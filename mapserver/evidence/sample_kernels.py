"""Samples before the fold (compiled): positions, spread of their weight, and votes."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import (
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
from mapserver.evidence.fold_kernels import BLOCK_BITS, BUCKET_BITS, HALF

_DOUBT_PER_UNIT = ev.SHARE_ONE / ev.DOUBT_MOST
_R_LAST, _G_LAST = ev.RESISTANCE_BINS - 2, ev.GRADE_BINS - 2
_R_PER_LOG = len(RESISTANCE_STEPS) / np.log(ev.RESISTANCE_CENTRES[-1] / ev.RESISTANCE_CENTRES[0])
_R_OFFSET = 0.5 - np.log(ev.RESISTANCE_CENTRES[0]) * _R_PER_LOG
_G_TOP = (ev.GRADE_BINS - 1) * ev.SHARE_ONE
_SECTOR_RAD, _SECTORS = 2 * np.pi / ev.SECTORS, ev.SECTORS
_UNITS, _ONE = ev.WEIGHT_UNITS_PER_M, ev.SHARE_ONE
_HASH = np.uint64(HASH)
SIGMAS = 3.0  # standard deviations that a position may be off
MOST_STEP_M = 2.0  # metres per sample, whatever its stamp; agents send one every 0.5 m
MOST_MPS = 30.0  # m/s that stamps allow, up to NEAR_M
NEAR_M = 5.0  # metres that are no jump: wheels report at 5 Hz, up to 25 m/s
_TABLE = TABLE.astype(np.uint32)


@numba.njit(cache=True, nogil=True)
def extent(rows: Any) -> tuple[int, int, float]:
    """Oldest and newest stamp, and metres driven."""
    oldest_ns, newest_ns, driven_m = rows[0].stamp_ns, rows[0].stamp_ns, 0.0
    for k in range(len(rows)):
        oldest_ns = min(oldest_ns, rows[k].stamp_ns)
        newest_ns = max(newest_ns, rows[k].stamp_ns)
        driven_m += np.float64(rows[k].distance_m)
    return oldest_ns, newest_ns, driven_m


@numba.njit(cache=True, nogil=True)
def count_foldable(rows: Any, cap_m2: float) -> int:
    """Rows that vote by `is_foldable`."""
    count = 0
    for k in range(len(rows)):
        row = rows[k]
        largest_m2 = _largest(np.float64(row.cov_xx_m2), np.float64(row.cov_xy_m2), np.float64(row.cov_yy_m2))
        count += largest_m2 <= cap_m2
    return count


@numba.njit(cache=True, nogil=True)
def _largest(xx: float, xy: float, yy: float) -> float:
    """Larger eigenvalue."""
    half = (xx - yy) / 2
    largest: float = (xx + yy) / 2 + np.sqrt(half * half + xy * xy)
    return largest


@numba.njit(cache=True, nogil=True)
def locate(
    rows: Any, limits: tuple[float, float, float], bucket_ns: int, places: Any, stencils: Any, keys: Any, touching: Any
) -> tuple[int, int]:
    """Positions of rows and the blocks of their stencils.

    limits: cell [m], variance added to positions, largest that votes [m2]. Fills places (n, 5): position [cells],
    inverse covariance xx, 2 xy, yy; stencils (n, 3): first column and row, edge [cells], 0 for no vote; keys, touching:
    key and row per touched block, while they fit. Returns their number, and all stencils' area.
    """
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
                if used < len(keys):
                    keys[used] = ((x + HALF) << (BLOCK_BITS + BUCKET_BITS)) | ((y + HALF) << BUCKET_BITS) | bucket
                    touching[used] = k
                used += 1
    return used, area


@numba.njit(cache=True, nogil=True)
def _place(row: Any, limits: tuple[float, float, float], out: Any) -> int:
    """Fill position and inverse covariance in cells; returns the reach, -1 for no vote."""
    cell_m, floor_m2, cap_m2 = limits
    cov_xx, cov_xy, cov_yy = np.float64(row.cov_xx_m2), np.float64(row.cov_xy_m2), np.float64(row.cov_yy_m2)
    if not _largest(cov_xx, cov_xy, cov_yy) <= cap_m2:
        return -1
    per_m2 = 1 / (cell_m * cell_m)
    most = np.sqrt(cov_xx * cov_yy)
    xx, yy = (cov_xx + floor_m2) * per_m2, (cov_yy + floor_m2) * per_m2
    xy = min(max(cov_xy, -most), most) * per_m2  # rounding must not make the covariance indefinite
    scale = 1 / (xx * yy - xy * xy)
    out[0], out[1] = row.x_m / cell_m, row.y_m / cell_m
    out[2], out[3], out[4] = yy * scale, -2 * xy * scale, xx * scale
    return int(np.ceil(2 * np.sqrt(max(xx, yy))))


@numba.njit(cache=True, nogil=True)
def survey(
    rows: Any,
    limits: tuple[float, float, float],
    bucket_ns: int,
    before: tuple[float, float, bool, int],
    steps: Any,
    entered: Any,
) -> tuple[int, bool]:
    """Metres and jumps of a machine, and blocks where its rows vote anew, also for new buckets.

    limits: of `locate`. before: last position (NaN: unknown), whether it jumped there, stamp. Fills steps (n, 2):
    metres, and 1 from a jump to a vote; entered: block key and row, while they fit. Returns their number, and whether a
    jump is open.
    """
    x, y, has_jumped, stamp_ns = before
    used, driven_m, place = 0, 0.0, np.empty(5)
    west, east, south, north = 0, -1, 0, -1  # blocks of the last voting row
    for k in range(len(rows)):
        row = rows[k]
        distance_m, shift_m = np.float64(row.distance_m), np.hypot(row.x_m - x, row.y_m - y)
        variance_m2 = _largest(np.float64(row.cov_xx_m2), np.float64(row.cov_xy_m2), np.float64(row.cov_yy_m2))
        off_m = SIGMAS * np.sqrt(min(variance_m2, limits[2]) + limits[1])
        if shift_m <= max(distance_m, NEAR_M) + off_m:
            fast_m = min(MOST_MPS * 1e-9 * (row.stamp_ns - stamp_ns), NEAR_M)
            driven_m += min(distance_m, shift_m, max(fast_m, MOST_STEP_M))
        else:
            has_jumped = True
        if row.stamp_ns // bucket_ns != stamp_ns // bucket_ns:
            west, east = 0, -1
        x, y, stamp_ns, steps[k, 0], steps[k, 1] = row.x_m, row.y_m, row.stamp_ns, driven_m, has_jumped
        reach = _place(row, limits, place) if distance_m > 0 else -1
        if reach < 0:
            continue
        has_jumped = False
        column, line = int(np.floor(place[0])), int(np.floor(place[1]))
        first_x, last_x = (column - reach) >> 4, (column + reach) >> 4
        first_y, last_y = (line - reach) >> 4, (line + reach) >> 4
        for block_y in range(first_y, last_y + 1):
            for block_x in range(first_x, last_x + 1):
                if not (west <= block_x <= east and south <= block_y <= north):
                    if used < len(entered):
                        entered[used] = block_key(block_x, block_y), k
                    used += 1
        west, east, south, north = first_x, last_x, first_y, last_y
    return used, has_jumped


@numba.njit(cache=True, nogil=True)
def block_key(x: int, y: int) -> int:
    """A block's column and row as one number."""
    return ((x + HALF) << BLOCK_BITS) | (y + HALF)


@numba.njit(cache=True, nogil=True)
def weigh(rows: Any, places: Any, stencils: Any, starts: Any, shares: Any) -> None:
    """Spread weights over stencils.

    Fills shares with stencils (edge, edge) from starts (n,). Integer shares sum exactly to a weight; the middle takes
    the remainder.
    """
    used = ev.ZERO
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
    """Fill a stencil from the table; returns the sum."""
    n = stencil[2]
    total = 0
    first, px, xx = stencil[0] + 0.5, place[0], place[2]
    for dy in range(n):
        y = (stencil[1] + dy + 0.5) - place[1]
        b, c = place[3] * y, place[4] * y * y
        at = np.uint64(used + dy * n)
        for dx in range(np.uint64(n)):  # unsigned, to avoid checks for negative indices
            x = (first + np.float64(dx)) - px
            d2 = (xx * x + b) * x + c
            weight = _TABLE[np.uint32(min(d2 * TABLE_PER_UNIT, TABLE_LAST))]
            shares[at + dx] = weight
            total += int(weight)
    return total


@numba.njit(cache=True, nogil=True)
def split(rows: Any, names: Any, bins: Any, shares: Any, bits: Any, stamps: Any) -> None:
    """Votes of rows; names (n,): hashes.

    Fills bins (n, 4): resistance, grade east, grade north (-1: no vote), heading sector; shares (n, 5) in 1/256: of the
    bin above, then deviation of c_rr over DOUBT_MOST and share of the position from lanes, rounded up; bits (n, 2):
    visit and machine, by the top six bits of a hash; stamps (n,).
    """
    for k in range(len(rows)):
        row = rows[k]
        bins[k, 0], shares[k, 0] = _split_resistance(np.float64(row.c_rr))
        bins[k, 1], shares[k, 1] = _split_grade(np.float64(row.grade_e))
        bins[k, 2], shares[k, 2] = _split_grade(np.float64(row.grade_n))
        shares[k, 3] = _doubt(np.float64(row.c_rr_var))
        shares[k, 4] = np.uint32(np.ceil(np.float64(row.aid_share) * _ONE))
        bins[k, 3] = np.int64(np.floor(np.float64(row.heading_rad) / _SECTOR_RAD + 0.5)) % _SECTORS
        visit = (names[k] + np.uint64(row.stamp_ns // VISIT_NS)) * _HASH
        bits[k, 0], bits[k, 1] = np.uint64(1) << (visit >> np.uint64(58)), np.uint64(1) << (names[k] >> np.uint64(58))
        stamps[k] = row.stamp_ns


@numba.njit(cache=True, nogil=True)
def _split_resistance(c_rr: float) -> tuple[int, Any]:
    """Lower bin, and share of the bin above, linear in log(c_rr), clipped; -1 for unknown."""
    if np.isnan(c_rr):
        return -1, np.uint32(0)
    place = int(min(max(np.log(max(c_rr, 1e-9)) * _R_PER_LOG + _R_OFFSET, 0.0), len(RESISTANCE_STEPS)))  # first guess
    while place < len(RESISTANCE_STEPS) and RESISTANCE_STEPS[place] <= c_rr:
        place += 1
    while place > 0 and RESISTANCE_STEPS[place - 1] > c_rr:
        place -= 1
    lower = min(place // _ONE, _R_LAST)
    return lower, np.uint32(place - lower * _ONE)


@numba.njit(cache=True, nogil=True)
def _doubt(variance: float) -> Any:
    """Deviation in 1/256 of DOUBT_MOST, rounded up and clipped; all of it without a variance."""
    return np.uint32(np.ceil(np.sqrt(variance) * _DOUBT_PER_UNIT) if variance < ev.DOUBT_MOST**2 else _ONE)


@numba.njit(cache=True, nogil=True)
def _split_grade(grade: float) -> tuple[int, Any]:
    """Lower bin, and share of the bin above, clipped; -1 for unknown."""
    if np.isnan(grade):
        return -1, np.uint32(0)
    place = int(min(max(np.rint((grade - GRADE_LOW) * GRADE_STEPS), 0), _G_TOP))
    lower = min(place // _ONE, _G_LAST)
    return lower, np.uint32(place - lower * _ONE)
