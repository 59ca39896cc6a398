"""The displacement of one map from another, by the levels around borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.trust.coarse_map import ROW, Surface, block_of
from protocol.arrays import Bools, Floats, Ints

REACH = 3  # cells tried in each direction
_EDGE = 2 * REACH + 1
_SHIFTS = _EDGE * _EDGE
ERROR_LENGTH_M = 200.0  # metres driven with one position error: twice 30 s at 3 m/s
_MOST_CELLS = 4000  # cells compared; more cost time and add nothing
_FEWEST_CELLS = 50
_BORDER_BITS, _BORDER_LEVELS = 3, 0.25  # a square of 16 m with this range of levels holds a border
_CLIP = 1.0  # limit of level differences, or borders of sand alone would decide
# Relative cost per squared cell, because parallel borders do not show shifts along them.
_PRICE = 0.01
_GROUPS = 8  # groups of 32 m squares, left out in turn (jackknife)
_GROUP_BITS = 4

_STEPS = np.arange(-REACH, REACH + 1)
_PRICES: Floats = _PRICE * (_STEPS[:, None] ** 2 + _STEPS[None, :] ** 2).ravel().astype(np.float64)


@dataclass(frozen=True)
class Shift:
    """A displacement, its deviation (both axes), and the share of borders that supports it."""

    east_m: float
    north_m: float
    std_m: float
    share: float


def find_shift(one: Surface, other: Surface, borders: Ints, expected: Floats, cell_m: float) -> Shift | None:
    """Displacement of the first map; None if too few borders show it.

    borders: (n,) cells of the other map; expected: (n,) levels there.
    """
    if not len(borders) or not len(one.codes):
        return None
    at = other.codes[borders]
    error, known = _errors(one.codes, one.level, at, expected)
    both = known[:, _SHIFTS // 2]
    if both.sum() < _FEWEST_CELLS:
        return None
    costs, counts = _by_group(at, error), _by_group(at, known.astype(np.float64))
    east, north = _best(costs.sum(axis=0), counts.sum(axis=0))
    rest = np.array([_best(c, n) for c, n in zip(costs.sum(axis=0) - costs, counts.sum(axis=0) - counts, strict=True)])
    jackknife = (1 - 1 / len(rest)) * float(((rest - rest.mean(axis=0)) ** 2).sum()) * cell_m**2
    metres = float(one.metres.mean()) * both.sum(), float(other.metres[borders][both].sum())
    drawn = sum(2 * s.std_m**2 * ERROR_LENGTH_M / m for s, m in zip((one, other), metres, strict=True))
    moved = (round(north) + REACH) * _EDGE + round(east) + REACH
    gained = np.where(both & known[:, moved], error[:, _SHIFTS // 2] - error[:, moved], 0.0)
    return Shift(east * cell_m, north * cell_m, float(np.sqrt(jackknife + drawn)), _share(at, gained))


def _share(codes: Ints, gained: Floats) -> float:
    """Gains over gains and losses of squares: a repaved zone misleads only its own."""
    squares, index = np.unique(block_of(codes, _GROUP_BITS), return_inverse=True)
    gains = np.bincount(index, gained, len(squares))
    return float(gains[gains > 0].sum() / max(np.abs(gains).sum(), 1e-9))


def near_borders(surface: Surface) -> Ints:
    """Cells in squares with a border, evenly sampled."""
    squares = block_of(surface.codes, _BORDER_BITS)
    order = np.argsort(squares, kind="stable")
    if not len(order):
        return order
    first = np.flatnonzero(np.diff(squares[order], prepend=-1))
    level = surface.level[order]
    spread = np.maximum.reduceat(level, first) - np.minimum.reduceat(level, first)
    near = np.sort(order[np.repeat(spread > _BORDER_LEVELS, np.diff(first, append=len(order)))])
    return near[:: 1 + len(near) // _MOST_CELLS]


def _errors(codes: Ints, level: Floats, at: Ints, expected: Floats) -> tuple[Floats, Bools]:
    """Clipped squared differences (n, shifts), 0 if unknown; and which are known."""
    levels = np.full((len(at), _EDGE, _EDGE), np.nan)
    for i, north in enumerate(_STEPS):
        west = at + north * ROW - REACH
        place = np.searchsorted(codes, west)
        for step in range(_EDGE):  # at most this many codes
            index = np.minimum(place + step, len(codes) - 1)
            column = codes[index] - west
            hit = np.flatnonzero((column >= 0) & (column < _EDGE))
            levels[hit, i, column[hit]] = level[index[hit]]
    difference = levels.reshape(len(at), _SHIFTS) - expected[:, None]
    known = ~np.isnan(difference)
    return np.where(known, np.minimum(difference**2, _CLIP**2), 0.0), known


def _by_group(codes: Ints, values: Floats) -> Floats:
    """Sums (groups, shifts)."""
    group = ((codes >> _GROUP_BITS) * 5 + (codes // ROW >> _GROUP_BITS) * 3) % _GROUPS
    order = np.argsort(group, kind="stable")  # no matrix product, which would start BLAS threads
    return np.add.reduceat(values[order], np.flatnonzero(np.diff(group[order], prepend=-1)), axis=0)


def _best(costs: Floats, counts: Floats) -> tuple[float, float]:
    """Cells east and north of the least mean cost, refined by parabolas."""
    enough = counts >= counts.max() / 2
    mean = costs / np.maximum(counts, 1)
    cost = np.where(enough, mean + _PRICES * mean[enough].mean(), np.inf).reshape(_EDGE, _EDGE)
    row, column = divmod(int(np.argmin(cost)), _EDGE)
    return column - REACH + _vertex(cost[row], column), row - REACH + _vertex(cost[:, column], row)


def _vertex(cost: Floats, lowest: int) -> float:
    if not 0 < lowest < _EDGE - 1:
        return 0.0
    below, least, above = cost[lowest - 1 : lowest + 2]
    bend = below + above - 2 * least
    return float((below - above) / bend / 2) if 0 < bend < np.inf else 0.0
