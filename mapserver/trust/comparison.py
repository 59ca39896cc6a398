"""How two maps of the same ground at the same time differ, whoever is right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mapserver.trust.coarse_map import LEVEL_FLOOR, ROW, Surface
from mapserver.trust.shift import Shift, find_shift, near_borders
from mapserver.trust.tuning import TUNING, TrustTuning
from protocol.arrays import Floats, Ints

_LOWEST_C_RR = 0.004  # lower bound: ratios of less mean nothing
_MOST_CELLS = 8000
_MEDIAN_ERROR = 1.85  # factor from a median absolute deviation to a median's standard error, 1.25 / 0.6745


@dataclass(frozen=True)
class Gain:
    """Ratio of the coefficients of two maps.

    log: its logarithm, std its standard error; share: of ground that differs in the same direction; c_rr: typical.
    """

    log: float
    std: float
    share: float
    c_rr: float


@dataclass(frozen=True)
class Difference:
    """Difference of the first map from the second.

    cells: compared, of the same period; shift: None if no border shows it; agreement: share of cells, after gain and
    shift; spreads: deviations of levels, own and other.
    """

    cells: int
    gain: Gain
    shift: Shift | None
    agreement: float
    spreads: tuple[float, float]


@dataclass(frozen=True)
class ComparedMap:
    """A map by period, and by place alone."""

    timed: Surface
    placed: Surface

    @cached_property
    def borders(self) -> Ints:
        """Indices of places near borders."""
        return near_borders(self.placed)


def compare(one: ComparedMap, other: ComparedMap, cell_m: float, tuning: TrustTuning = TUNING) -> Difference | None:
    """Compare two maps; None if they share too little ground.

    Gain and agreement need the same period. The shift does not, as rain moves no border, and it needs every one.
    """
    a, b = _common(one.timed.codes, other.timed.codes)
    cells = len(a)
    if cells < tuning.min_cells:
        return None
    a, b = _thinned(a, b)
    gain = _gain(one.timed, other.timed, a, b, cell_m, tuning)
    shift = _shift(one, other, cell_m, tuning)
    return Difference(
        cells=cells,
        gain=gain,
        shift=shift,
        agreement=_agreement(one.timed, other.timed, b, gain.log, shift, cell_m, tuning.tolerance),
        spreads=(float(np.std(one.timed.level[a])), float(np.std(other.timed.level[b]))),
    )


def reverse(d: Difference) -> Difference:
    """The difference of the second map from the first."""
    shift = replace(d.shift, east_m=-d.shift.east_m, north_m=-d.shift.north_m) if d.shift else None
    return replace(d, gain=replace(d.gain, log=-d.gain.log), shift=shift, spreads=(d.spreads[1], d.spreads[0]))


def _common(one: Ints, other: Ints) -> tuple[Ints, Ints]:
    """Indices of common codes in both."""
    if not len(one):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    place = np.minimum(np.searchsorted(one, other), len(one) - 1)
    hit = np.flatnonzero(one[place] == other)
    return place[hit], hit


def _gain(one: Surface, other: Surface, a: Ints, b: Ints, cell_m: float, tuning: TrustTuning) -> Gain:
    """Median log ratio; cells weigh less where a bias may hide it."""
    c_one, c_other = _c_rr(one.level[a]), _c_rr(other.level[b])
    c_rr = np.sqrt(c_one * c_other)
    metres = np.minimum(np.minimum(one.metres[a], other.metres[b]), cell_m)
    weight = metres / (tuning.scatter**2 + (tuning.zero_error / c_rr) ** 2)
    ratio = np.log(c_one / c_other)
    log = _weighted_median(ratio, weight)
    draws = max(1.0, weight.sum() ** 2 / (weight @ weight) / tuning.cells_per_draw)
    same_direction = ratio * np.sign(log) > abs(log) / 2
    return Gain(
        log=log,
        std=_MEDIAN_ERROR * _weighted_median(np.abs(ratio - log), weight) / float(np.sqrt(draws)),
        share=float(weight @ same_direction / weight.sum()),
        c_rr=_weighted_median(c_rr, weight),
    )


def _shift(one: ComparedMap, other: ComparedMap, cell_m: float, tuning: TrustTuning) -> Shift | None:
    """Displacement of the places, after their gain."""
    a, b = _thinned(*_common(one.placed.codes, other.placed.codes))
    gain = _gain(one.placed, other.placed, a, b, cell_m, tuning)
    expected = _with_gain(other.placed.level[other.borders], gain.log)
    return find_shift(one.placed, other.placed, other.borders, expected, cell_m)


def _agreement(
    one: Surface, other: Surface, b: Ints, log_gain: float, shift: Shift | None, cell_m: float, tolerance: float
) -> float:
    """Agreement with or without the shift, whichever is more."""
    moves = {0}
    if shift:
        moves.add(round(shift.north_m / cell_m) * ROW + round(shift.east_m / cell_m))
    expected = _with_gain(other.level[b], log_gain)
    shares = []
    for move in moves:
        own, at = _common(one.codes, other.codes[b] + move)
        shares.append(float(np.mean(np.abs(one.level[own] - expected[at]) <= tolerance)) if len(at) else 0.0)
    return max(shares)


def _c_rr(level: Floats) -> Floats:
    return np.maximum(np.exp(level) - LEVEL_FLOOR, _LOWEST_C_RR)


def _with_gain(level: Floats, log_gain: float) -> Floats:
    return np.asarray(np.log(_c_rr(level) * np.exp(log_gain) + LEVEL_FLOOR), np.float64)


def _thinned(a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """Sample evenly: more pairs do not improve medians."""
    stride = 1 + len(a) // _MOST_CELLS
    return a[::stride], b[::stride]


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])
