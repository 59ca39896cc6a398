"""Prices of unknown ground, by a rule on the ground around it, so that every query gets the same.

A square is priced by its own ground and the eight squares around. Unknown cells cost the worst 10 % of the known,
uphill. Filled cells are estimates: they cost their mean plus a share of the surcharge for unknown ground, in proportion
to their standard deviation.

Unknown slopes follow from heights, because a line across has to climb what known ground around climbs. Heights h fit
measured gradients g best:

    sum over neighbours  w ((h_j - h_i) / d - g)^2  least,   w = 1 and g measured; w small and g = 0 elsewhere

so they are harmonic between known ground.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from scipy.linalg import solveh_banded

from mapserver.error_model import RESISTANCE_PRIOR_STD
from mapserver.routes.ground import Squares
from protocol.arrays import AnyArray, Bools, Floats, Ints

DEAREST = 0.9  # quantile of known cost; at the median, the cheapest line would cross any unknown ground
LOOSE = 0.25  # price without known ground nearby, as loose sand
BINS = np.geomspace(0.001, 5.0, 257)  # edges of resistance plus slope, 3 % each
NEEDS = ("resistance_filled", "resistance_filled_std", "grade_east_filled", "grade_north_filled", "visits")
RESISTANCE, EAST, NORTH = PRICED = ("price", "price_east", "price_north")
Square = tuple[int, int]
COARSE = 8  # cells to a side of a coarse cell; hills are larger
FAINT = 1e-3  # weight of unknown ground, too small to bend what is measured
HOLD = 1e-9  # regularises the mean height, which nothing measures


def around(squares: Iterable[Square]) -> set[Square]:
    """Squares that these prices depend on: themselves and the eight around each."""
    return {(x + right, y + up) for x, y in squares for right, up in product((-1, 0, 1), repeat=2)}


def bare(squares: Squares, among: Iterable[Square]) -> set[Square]:
    """Squares with cells that are unvisited or have no resistance."""
    whole = np.isfinite(squares.layers["visits"] + squares.layers["resistance_filled"]).reshape(len(squares.places), -1)
    return set(among) - {place for place, at in squares.by_place().items() if whole[at].all()}


class Prices:
    """Prices by square, cached; search and drive read the same.

    squares: NEEDS of all `around` the wanted ones. given: resistance of unknown ground, None for the rule.
    Single-threaded.
    """

    def __init__(self, squares: Squares, given: float | None = None) -> None:
        self.given, self._squares, self._index = given, squares, squares.by_place()
        self._known: dict[Square, dict[str, Floats]] = {}

    def squares(self, wanted: Set[Square]) -> Squares:
        """PRICED of squares: resistance, slope east, slope north; NaN where measured.

        Visited cells without resistance take that of the nearest measured cell.
        """
        for square in wanted - self._known.keys():
            self._known[square] = self._priced(square)
        return Squares.stacked(
            self._squares.cell_m, self._squares.edge, {square: self._known[square] for square in wanted}
        )

    @cached_property
    def _layers(self) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Resistance, its deviation, visited cells, and measured slopes (k, n, n)."""
        resistance, std, east, _, visits = (self._squares.layers[name] for name in NEEDS)
        driven = np.isfinite(visits)
        return resistance, std, driven, driven & np.isfinite(east)

    @cached_property
    def _counted(self) -> Ints:
        """Histogram of known cost in each square."""
        resistance, _, driven, _ = self._layers
        east, north = (self._squares.layers[name] for name in NEEDS[2:4])
        steep = np.hypot(east, north)
        return _counts(resistance + np.where(np.isfinite(steep), steep, 0), driven & np.isfinite(resistance))

    @cached_property
    def _rises(self) -> Rises:
        east, north = (self._squares.layers[name] for name in NEEDS[2:4])
        return Rises.of_slopes(east, north, self._layers[3])

    def _priced(self, square: Square) -> dict[str, Floats]:
        edge, (resistance, std, driven, sloped) = self._squares.edge, self._layers
        near = [[self._index.get((square[0] + x, square[1] + y)) for x in (-1, 0, 1)] for y in (-1, 0, 1)]
        own, doubt, is_driven, is_sloped = np.full((edge, edge), np.nan), 0.0, False, False
        if (at := near[1][1]) is not None:
            own, is_driven, is_sloped = resistance[at].astype(np.float64), driven[at], sloped[at]
            doubt = np.clip(std[at] / own / RESISTANCE_PRIOR_STD, 0.0, 1.0)
        dear = (
            self.given
            if self.given is not None
            else _dearest(self._counted[[at for row in near for at in row if at is not None]].sum(axis=0))
        )
        measured = np.isfinite(own)
        price = np.where(measured, own + doubt * np.maximum(dear - own, 0.0), dear)
        if (unmeasured := is_driven & ~measured).any():
            known = _joined(driven & np.isfinite(resistance), near, 0.0) > 0
            price = np.where(unmeasured, _nearest(_joined(resistance, near, np.nan), known, dear), price)
        height = heights(Rises(*(_joined(part, near, 0.0) for part in vars(self._rises).values())))
        m = len(height) // 3
        even = slopes(height[m - 1 : 2 * m + 1, m - 1 : 2 * m + 1])
        return {
            RESISTANCE: np.where(is_driven & measured, np.nan, price),
            **{
                name: np.where(is_sloped, np.nan, part[:edge, :edge])
                for name, part in zip((EAST, NORTH), even, strict=True)
            },
        }


def _counts(values: AnyArray, known: Bools) -> Ints:
    """Histograms over BINS of known values (k, n, n), by square."""
    bins = np.digitize(values[known], BINS[1:-1]) + (len(BINS) - 1) * np.nonzero(known)[0]
    return np.bincount(bins, minlength=len(known) * (len(BINS) - 1)).reshape(len(known), -1)


def _dearest(counts: Ints) -> float:
    """Quantile DEAREST of counts in BINS, log-linear within a bin; LOOSE if empty."""
    total = np.cumsum(counts)
    if not total[-1]:
        return LOOSE
    rank = DEAREST * total[-1]
    bin_ = int(np.searchsorted(total, rank))
    share = (rank - (total[bin_ - 1] if bin_ else 0)) / counts[bin_]
    return float(BINS[bin_] * (BINS[bin_ + 1] / BINS[bin_]) ** share)


def _joined(values: AnyArray, near: Sequence[Sequence[int | None]], otherwise: float) -> Floats:
    """Join 3 x 3 squares of values (k, n, n) into (3 n, 3 n); otherwise: for missing squares."""
    n = values.shape[-1]
    out = np.full((3 * n, 3 * n), otherwise)
    for y, row in enumerate(near):
        for x, at in enumerate(row):
            if at is not None:
                out[y * n : (y + 1) * n, x * n : (x + 1) * n] = values[at]
    return out


def _nearest(values: Floats, known: Bools, otherwise: float) -> Floats:
    """Values of the nearest known cell (3 n, 3 n), for the middle (n, n)."""
    n = len(values) // 3
    if not known.any():
        return np.full((n, n), otherwise)
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(label.max() + 1)
    by_label[label[known]] = values[known]
    return np.asarray(by_label[label[n : 2 * n, n : 2 * n]])


@dataclass(frozen=True)
class Rises:
    """Rises over coarse cells (..., m, m) to the east and north, in cells, and the known share of each."""

    east: Floats
    north: Floats
    share: Floats

    @classmethod
    def of_slopes(cls, east: Floats, north: Floats, known: Bools) -> Rises:
        """From slopes (..., n, n) [m/m]; m coarse cells cover n."""
        number = _sums(known.astype(np.float64))
        east_sum, north_sum = (_sums(np.where(known, grade, 0.0)) for grade in (east, north))
        per_cell = COARSE / np.maximum(number, 1.0)
        return cls(east_sum * per_cell, north_sum * per_cell, number / COARSE**2)


def heights(rises: Rises) -> Floats:
    """Best-fitting heights (m, m), in cells."""
    size = len(rises.share)
    band = np.zeros((size + 1, size * size))  # bands of the normal equations: diagonal, right, above
    wanted = np.zeros((size, size))
    diagonal, right, above = (band[row].reshape(size, size) for row in (0, 1, size))
    diagonal += HOLD
    for off, rise, first, second in (
        (right, rises.east, np.s_[:, :-1], np.s_[:, 1:]),
        (above, rises.north, np.s_[:-1], np.s_[1:]),
    ):
        share = np.minimum(rises.share[first], rises.share[second])
        weight = np.maximum(share, FAINT)
        pulls = weight * np.where(share > 0.0, 0.5 * (rise[first] + rise[second]), 0.0)
        diagonal[first] += weight
        diagonal[second] += weight
        off[first] -= weight
        wanted[first] -= pulls
        wanted[second] += pulls
    return np.asarray(solveh_banded(band, wanted.ravel(), lower=True, check_finite=False).reshape(size, size))


def slopes(height: Floats) -> tuple[Floats, Floats]:
    """Slopes (n, n) east and north [m/m], inside the outermost coarse cells."""
    fine = cv2.resize(height, None, fx=COARSE, fy=COARSE, interpolation=cv2.INTER_LINEAR)
    inner = slice(COARSE, -COARSE)
    north, east = np.gradient(fine)
    return east[inner, inner], north[inner, inner]


def _sums(values: Floats) -> Floats:
    """Sums (..., m, m) over COARSE x COARSE cells of (..., n, n), padded with 0."""
    short = -values.shape[-1] % COARSE
    whole = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(0, short)] * 2)
    m = whole.shape[-1] // COARSE
    return np.asarray(whole.reshape(*whole.shape[:-2], m, COARSE, m, COARSE).sum(axis=(-3, -1)))
