"""What ground costs where nobody was: a rule of the ground around it, so that whoever asks is told the same.

A square is priced by what was measured in it and in the eight around it. Its unknown ground resists as much as the
dearest tenth of that does uphill, and rises as the known ground around says that it must. What a layer fills in beside
driven ground is nobody's knowledge either: it resists as its mean, and as much of what unknown ground costs more as its
deviation is of the one that filling begins with.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from functools import cached_property
from itertools import product

import cv2
import numpy as np

from mapserver.layers.gap_filling import RESISTANCE_PRIOR_STD
from mapserver.routes.ground import Squares
from mapserver.routes.heights import Rises, heights, slopes
from protocol.arrays import AnyArray, Bools, Floats, Ints

DEAREST = 0.9  # of what is known is cheaper; at the median, a cheapest line leads through whatever nobody has driven
LOOSE = 0.25  # as loose sand: what unknown ground costs that has nothing measured in the squares around its own
BINS = np.geomspace(0.001, 5.0, 257)  # of resistance and slope together, 3 % each
NEEDS = ("resistance_filled", "resistance_filled_std", "grade_east_filled", "grade_north_filled", "visits")
RESISTANCE, EAST, NORTH = PRICED = ("price", "price_east", "price_north")
Square = tuple[int, int]


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
