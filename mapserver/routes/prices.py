"""What ground costs where nobody was: a rule of the ground around it, so that whoever asks is told the same.

A square is priced by what was measured in it and in the eight around it. Its unknown ground resists as much as the
dearest tenth of that does uphill, and rises as the known ground around says that it must. What a layer fills in beside
driven ground is nobody's knowledge either: it resists as its mean, and as much of what unknown ground costs more as its
deviation is of the one that filling begins with.

Slopes of ground where nobody was, from heights that its surroundings have in common.

No gradient was measured there, but a line through it leads from one place of known slopes to another, and has to climb
what the known ways between them climb. So heights h over a window are those that agree best with measured gradients g,

    sum over neighbours  w ((h_j - h_i) / d - g)^2  least,   w = 1 and g measured; w small and g = 0 where none was,

which makes them harmonic between known ground: as even as it lets them be.
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

DEAREST = 0.9  # of what is known is cheaper; at the median, a cheapest line leads through whatever nobody has driven
LOOSE = 0.25  # as loose sand: what unknown ground costs that has nothing measured in the squares around its own
BINS = np.geomspace(0.001, 5.0, 257)  # of resistance and slope together, 3 % each
NEEDS = ("resistance_filled", "resistance_filled_std", "grade_east_filled", "grade_north_filled", "visits")
RESISTANCE, EAST, NORTH = PRICED = ("price", "price_east", "price_north")
Square = tuple[int, int]
COARSE = 8  # cells to a side of those that heights are told for: hills are larger
FAINT = 1e-3  # weight of ground where nobody was: it follows what is measured, and hardly bends it
HOLD = 1e-9  # of the mean height, which nothing tells


def around(squares: Iterable[Square]) -> set[Square]:
    """The squares that prices of these follow from: they, and the eight around each."""
    return {(x + right, y + up) for x, y in squares for right, up in product((-1, 0, 1), repeat=2)}


def bare(squares: Squares, among: Iterable[Square]) -> set[Square]:
    """Those that have cells where nobody was, or none could tell the resistance."""
    whole = np.isfinite(squares.layers["visits"] + squares.layers["resistance_filled"]).reshape(len(squares.places), -1)
    return set(among) - {place for place, at in squares.by_place().items() if whole[at].all()}


class Prices:
    """What bare ground costs, square by square, each reckoned once: a way reads them for its search and for its drives.

    squares: NEEDS, of all `around` those that are wanted. given: what unknown ground resists, None: by the rule. For
    one thread at a time.
    """

    def __init__(self, squares: Squares, given: float | None = None) -> None:
        self.given, self._squares, self._index = given, squares, squares.by_place()
        self._known: dict[Square, dict[str, Floats]] = {}

    def squares(self, wanted: Set[Square]) -> Squares:
        """PRICED of wanted squares: resistance, slopes to the east and north; NaN where machines measured them.

        Where machines were and measured no resistance, it is that of the nearest place where they did.
        """
        for square in wanted - self._known.keys():
            self._known[square] = self._priced(square)
        return Squares.stacked(
            self._squares.cell_m, self._squares.edge, {square: self._known[square] for square in wanted}
        )

    @cached_property
    def _layers(self) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Resistance and its deviation, where machines were, and where they measured slopes (k, n, n)."""
        resistance, std, east, _, visits = (self._squares.layers[name] for name in NEEDS)
        driven = np.isfinite(visits)
        return resistance, std, driven, driven & np.isfinite(east)

    @cached_property
    def _counted(self) -> Ints:
        """How many known cells of each square are so dear."""
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
    """How many known values (k, n, n) of each square lie in each of BINS."""
    bins = np.digitize(values[known], BINS[1:-1]) + (len(BINS) - 1) * np.nonzero(known)[0]
    return np.bincount(bins, minlength=len(known) * (len(BINS) - 1)).reshape(len(known), -1)


def _dearest(counts: Ints) -> float:
    """DEAREST of values that were counted in BINS, even in the logarithm within each; LOOSE of none."""
    total = np.cumsum(counts)
    if not total[-1]:
        return LOOSE
    rank = DEAREST * total[-1]
    bin_ = int(np.searchsorted(total, rank))
    share = (rank - (total[bin_ - 1] if bin_ else 0)) / counts[bin_]
    return float(BINS[bin_] * (BINS[bin_ + 1] / BINS[bin_]) ** share)


def _joined(values: AnyArray, near: Sequence[Sequence[int | None]], otherwise: float) -> Floats:
    """Values (k, n, n) of three by three squares in one array (3 n, 3 n); otherwise: of those that are not there."""
    n = values.shape[-1]
    out = np.full((3 * n, 3 * n), otherwise)
    for y, row in enumerate(near):
        for x, at in enumerate(row):
            if at is not None:
                out[y * n : (y + 1) * n, x * n : (x + 1) * n] = values[at]
    return out


def _nearest(values: Floats, known: Bools, otherwise: float) -> Floats:
    """Values of the nearest known cell (3 n, 3 n), in those in the middle (n, n)."""
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
    """Known rises over coarse cells (..., m, m) to the east and north, in cells, and which share of each is known."""

    east: Floats
    north: Floats
    share: Floats

    @classmethod
    def of_slopes(cls, east: Floats, north: Floats, known: Bools) -> Rises:
        """From slopes (..., n, n) [m/m]; m: coarse cells that cover n."""
        number = _sums(known.astype(np.float64))
        east_sum, north_sum = (_sums(np.where(known, grade, 0.0)) for grade in (east, north))
        per_cell = COARSE / np.maximum(number, 1.0)
        return cls(east_sum * per_cell, north_sum * per_cell, number / COARSE**2)


def heights(rises: Rises) -> Floats:
    """Heights (m, m) in cells, that fit the known rises (m, m) best."""
    size = len(rises.share)
    band = np.zeros((size + 1, size * size))  # of the normal equations: the diagonal, what is to the right, and above
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
    """Slopes (n, n) to the east and north [m/m] of the cells in all coarse ones (m, m) but the outermost."""
    fine = cv2.resize(height, None, fx=COARSE, fy=COARSE, interpolation=cv2.INTER_LINEAR)
    inner = slice(COARSE, -COARSE)
    north, east = np.gradient(fine)
    return east[inner, inner], north[inner, inner]


def _sums(values: Floats) -> Floats:
    """Sums (..., m, m) over COARSE x COARSE cells of (..., n, n); the last ones may be cut short."""
    short = -values.shape[-1] % COARSE
    whole = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(0, short)] * 2)
    m = whole.shape[-1] // COARSE
    return np.asarray(whole.reshape(*whole.shape[:-2], m, COARSE, m, COARSE).sum(axis=(-3, -1)))
