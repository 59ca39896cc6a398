"""Change of the ground: where recent evidence contradicts older evidence, a read of the map skips the older.

For every cell, evidence is cut in two between two of its pages by time. The cut that explains it best (two kinds of
ground are more likely than one, by the log-likelihood ratio of their histograms) is a change if the two histograms have
little in common (total variation) and their medians differ by more than what machines differ by among themselves. What
comes after a cut is cut again, so that the last of several changes counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapserver.change.kernels import differ, histograms, likeliest_cuts, medians, sums
from mapserver.evidence import cells as ev
from mapserver.evidence.timeline import TimedPage, packed_votes
from protocol.arrays import Bools, Floats, Ints
from protocol.config import require_positive
from protocol.site.geometry import BLOCK_CELLS

VARIATION = 0.6  # total variation of two histograms, 0 to 1, above which they contradict each other
BINS = (
    1.5  # least difference of their medians, in bins (22 % of c_rr, 0.031 of gradient): medians are no finer than one
)
WEIGHT_M = 0.3  # least evidence on either side of a cut: a sample's vote in a cell beside its own is no pass
MOST_CHANGES = 4  # of one cell, in all that its pages remember
LEAST_SHARE = 0.5  # of a square of size_m that changed, where all else in it is not known
ALIKE_BINS = 1.0  # kinds of ground nearer to each other are the same; cells whose pages are nearer did not change
_PARTS = (ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH)


@dataclass(frozen=True)
class ChangeConfig:
    """When recent evidence replaces older evidence.

    detect: whether it ever does. size_m: changes narrower than this are position errors at a border, and those narrower
    than twice this where the new kind of ground is that of the ground beside.
    """

    detect: bool = True
    size_m: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, ("size_m",))


@dataclass(frozen=True)
class Cuts:
    """Where the evidence of a block's cells (256,) is cut.

    first: index of the first page that holds for the ground as it is now, 0 where nothing changed. kind: median of the
    c_rr votes after the cut, in bins; NaN where c_rr did not change.
    """

    first: Ints
    kind: Floats

    @property
    def has_change(self) -> bool:
        """Whether any cell changed."""
        return bool(self.first.any())


def cuts(pages: Sequence[TimedPage], config: ChangeConfig) -> Cuts:
    """Find the last change in every cell of a block."""
    last = Cuts(np.zeros(ev.CELLS, np.int64), np.full(ev.CELLS, np.nan))
    if len(pages) < 2 or not config.detect:
        return last
    votes_of_pages, ends = packed_votes(pages)
    least, most = 0.1 * WEIGHT_M * ev.WEIGHT_UNITS_PER_M, min(ALIKE_BINS, BINS / 2)
    for part in _PARTS:
        cells = np.flatnonzero(differ(votes_of_pages, ends, part.start, part.stop, least, most))
        if not len(cells):
            continue
        votes = _histograms(votes_of_pages, ends, part, cells)
        left = np.arange(len(cells))
        for _ in range(MOST_CHANGES):
            cut, kind = _best_cut(votes[:, :, left], last.first[cells[left]])
            changed = cut > last.first[cells[left]]
            left, cut, kind = left[changed], cut[changed], kind[changed]
            last.first[cells[left]] = cut
            last.kind[cells[left]] = kind if part == ev.RESISTANCE else np.nan
            if not len(left):
                break
    return last


def kinds(pages: Sequence[TimedPage]) -> Floats:
    """Median (256,) of all c_rr votes of each cell, in bins; NaN where they are too few for both sides of a cut."""
    packed, _ = packed_votes(pages)
    votes = sums(packed, ev.RESISTANCE.start, ev.RESISTANCE.stop) / ev.WEIGHT_UNITS_PER_M
    return np.where(votes.sum(axis=0) >= 2 * WEIGHT_M, medians(votes), np.nan)


def credible(changed: Bools, kind: Floats, now: Floats, cell_m: float, config: ChangeConfig) -> Bools:
    """Changed cells (rows, columns) that are no position errors.

    A wrong position moves the ground of one side of a border to the other. So a strip of changed cells counts where it
    is size_m wide and its new kind is not that of the ground around, or twice as wide. Trucks that keep to a lane make
    a narrower strip known: what is not known beside it speaks neither for the change nor against it, as long as the
    strip changed over size_m of its length. kind: after the change, as in Cuts; now: `kinds` of all cells.
    """
    edge = _edge(cell_m, config)
    ground = np.where(changed, np.nan, now)
    near = np.zeros(changed.shape, np.bool_)
    for one in np.unique(np.rint(kind[changed & np.isfinite(kind)])):
        alike = (np.abs(ground - one) <= ALIKE_BINS).astype(np.uint8)
        around = cv2.dilate(alike, np.ones((4 * edge + 1, 4 * edge + 1), np.uint8)) > 0
        near |= around & (np.rint(kind) == one)
    new = changed & np.isfinite(kind) & ~near
    return _opened(changed, 2 * edge) | _opened(new, edge) | _strips(new, ~changed & np.isnan(now), edge)


def reach_blocks(cell_m: float, config: ChangeConfig) -> int:
    """How many blocks away the cells are that `credible` looks at."""
    edge = _edge(cell_m, config)
    return -(-(4 * edge - 2) // BLOCK_CELLS)  # a square of 2 edge cells that holds a cell, and neighbours in it


def _edge(cell_m: float, config: ChangeConfig) -> int:
    return max(1, round(config.size_m / cell_m))


def _opened(cells: Bools, edge: int) -> Bools:
    """Those that lie in a square of `edge` cells, all of which are set."""
    square, last = np.ones((edge, edge), np.uint8), edge - 1
    # not MORPH_OPEN, which moves what it opens by a cell where the edge is even
    corners = cv2.erode(cells.astype(np.uint8), square, anchor=(0, 0), borderValue=0)
    return np.asarray(cv2.dilate(corners, square, anchor=(last, last), borderValue=0) > 0, np.bool_)


def _strips(cells: Bools, unknown: Bools, edge: int) -> Bools:
    """Those that lie in a square of `edge` cells which they cross from side to side, and half of which they are.

    All others in it are unknown, as is what lies outside of the image.
    """
    n, last, wide = edge, edge - 1, [(edge, edge), (edge, edge)]
    some, free = np.pad(cells, wide).astype(np.uint8), np.pad(cells | unknown, wide, constant_values=True)
    crossed: Bools = np.zeros(some.shape, np.bool_)
    for along, across in (((n, 1), (1, n)), ((1, n), (n, 1))):  # a cell in each of its rows, or columns
        touched = cv2.dilate(some, np.ones(across, np.uint8), anchor=(0, 0), borderValue=0)
        crossed |= cv2.erode(touched, np.ones(along, np.uint8), anchor=(0, 0), borderValue=0) > 0
    square = np.ones((n, n), np.uint8)
    count = cv2.filter2D(some, cv2.CV_32F, square.astype(np.float32), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    fits = cv2.erode(free.astype(np.uint8), square, anchor=(0, 0), borderValue=0) > 0
    corners = fits & crossed & (np.asarray(count) >= LEAST_SHARE * n**2)
    opened = cv2.dilate(corners.astype(np.uint8), square, anchor=(last, last), borderValue=0) > 0
    return np.asarray(cells & opened[n:-n, n:-n])


def _histograms(votes: NDArray[np.uint64], ends: Ints, part: slice, cells: Ints) -> Floats:
    """Votes (pages, bins, cells) of some cells in metres."""
    columns = np.full(ev.CELLS, -1)
    columns[cells] = np.arange(len(cells))
    counts = np.zeros((len(ends), part.stop - part.start, len(cells)))
    histograms(votes, ends, part.start, part.stop, columns, counts)
    metres: Floats = counts / ev.WEIGHT_UNITS_PER_M
    return metres


def _best_cut(votes: Floats, first: Ints) -> tuple[Ints, Floats]:
    """Index of the page (cells,) at which the ground changed, the given first page where it did not.

    votes: (pages, bins, cells); pages before `first` do not count. Also returns the median (cells,) after it.
    """
    best, variation, before, after = likeliest_cuts(votes, first, WEIGHT_M)
    changed = (best > 0) & (variation > VARIATION) & (np.abs(before - after) >= BINS)
    return np.where(changed, best, first), after
