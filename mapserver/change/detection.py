"""Change of the ground: where recent evidence contradicts older evidence, a read of the map skips the older.

For every cell, evidence is cut in two between two of its pages by time. The cut that explains it best (two kinds of
ground are more likely than one, by the log-likelihood ratio of their histograms) is a change if the two histograms have
little in common (total variation) and their medians differ by more than what machines differ by among themselves, and
by more than what their samples state. What comes after a cut is cut again, so that the last of several changes counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapserver.change.kernels import differ, histograms, likeliest_cuts, medians, sums, weights
from mapserver.error_model import MACHINE_SHARE
from mapserver.evidence import cells as ev
from mapserver.evidence.timeline import TimedPages
from protocol.arrays import Bools, Floats, Ints
from protocol.config import require_positive
from protocol.site.geometry import BLOCK_CELLS


@dataclass(frozen=True)
class ChangeTuning:
    """What is a change.

    variation: least total variation of two histograms, 0 to 1. bins: least difference of their medians, in bins (22 %
    of c_rr, 0.031 of gradient), as medians are no finer than one; c_rr: likewise on concrete, by what machines' zeros
    are off by (from 0.023 on bins ask for more); sigmas: likewise, in the deviations that samples state, as a site has
    hundreds of stretches. weight_m: least evidence on either side of a cut, as a sample's vote in a cell beside its own
    is no pass. most: changes of one cell, in all that its pages remember. share: of a square of size_m that changed,
    where all else in it is not known. alike_bins: kinds of ground nearer to each other are the same.
    """

    variation: float = 0.6
    bins: float = 1.5
    c_rr: float = 0.005
    sigmas: float = 3.0
    weight_m: float = 0.3
    most: int = 4
    share: float = 0.5
    alike_bins: float = 1.0


TUNING = ChangeTuning()
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
    c_rr votes after the cut, in bins; NaN where c_rr did not change. old_ns, new_ns: when the last page before the cut
    and the first one after it begin that know the cell, between which the ground changed; NaN where it did not.
    """

    first: Ints
    kind: Floats
    old_ns: Floats
    new_ns: Floats

    @property
    def has_change(self) -> bool:
        """Whether any cell changed."""
        return bool(self.first.any())


def _unchanged() -> Cuts:
    return Cuts(np.zeros(ev.CELLS, np.int64), *(np.full(ev.CELLS, np.nan) for _ in range(3)))


UNCHANGED = _unchanged()  # one for all blocks without a change, which are most: 8 KB each, kept with their pages


def cuts(pages: TimedPages, config: ChangeConfig, tuning: ChangeTuning = TUNING) -> Cuts:
    """Find the last change in every cell of a block."""
    if len(pages) < 2 or not config.detect:
        return UNCHANGED
    last = _unchanged()
    votes_of_pages, ends = pages.packed_votes()
    least, most = 0.1 * tuning.weight_m * ev.WEIGHT_UNITS_PER_M, min(tuning.alike_bins, tuning.bins / 2)
    for part in _PARTS:
        cells = np.flatnonzero(differ(votes_of_pages, ends, part.start, part.stop, least, most))
        if not len(cells):
            continue
        votes = _histograms(votes_of_pages, ends, part, cells)
        left = np.arange(len(cells))
        for _ in range(tuning.most):
            first = last.first[cells[left]]
            cut, kind, step = _best_cut(votes[:, :, left], first, part, tuning)
            changed = cut > first
            if part == ev.RESISTANCE and changed.any():
                changed[changed] = step[changed] > tuning.sigmas * _doubt(
                    pages, votes_of_pages, ends, cells[left[changed]], first[changed], cut[changed]
                )
            left, cut, kind = left[changed], cut[changed], kind[changed]
            last.first[cells[left]] = cut
            last.kind[cells[left]] = kind if part == ev.RESISTANCE else np.nan
            if not len(left):
                break
    if not last.has_change:
        return UNCHANGED
    index, begins_ns = np.arange(len(pages))[:, None], _begins_ns(pages)
    knows = weights(votes_of_pages, ends, ev.RESISTANCE.start, ev.RESISTANCE.stop) > 0
    old = np.where(knows & (index < last.first), index, 0).max(axis=0)
    new = np.where(knows & (index >= last.first), index, len(pages) - 1).min(axis=0)
    for times_ns, page in ((last.old_ns, old), (last.new_ns, new)):
        times_ns[:] = np.where(last.first > 0, begins_ns[page], np.nan)
    return last


@dataclass(frozen=True)
class Known:
    """What the c_rr votes of cells (n,) say, apart from changes.

    kind: median of all, in bins, NaN where they are too few for both sides of a cut. from_ns, until_ns: when the pages
    begin up to which, and from which on, there are enough for one side; NaN where there never are.
    """

    kind: Floats
    from_ns: Floats
    until_ns: Floats


def known(pages: TimedPages, tuning: ChangeTuning = TUNING) -> Known:
    """What is known of the cells (256,) of a block."""
    packed, ends = pages.packed_votes()
    span = ev.RESISTANCE.start, ev.RESISTANCE.stop
    weight = weights(packed, ends, *span) / ev.WEIGHT_UNITS_PER_M
    median = medians(sums(packed, *span) / ev.WEIGHT_UNITS_PER_M)
    kind = np.where(weight.sum(axis=0) >= 2 * tuning.weight_m, median, np.nan)
    begins_ns, least_m = _begins_ns(pages), tuning.weight_m
    return Known(kind, _reached(weight, begins_ns, least_m), _reached(weight[::-1], begins_ns[::-1], least_m))


def credible(cuts_of: Cuts, cells: Known, cell_m: float, config: ChangeConfig, tuning: ChangeTuning = TUNING) -> Bools:
    """Changed cells (rows, columns) that are no position errors; all values are images.

    A wrong position moves the ground of one side of a border to the other. So a strip of changed cells counts where it
    is size_m wide and its new kind is not that of the ground around, or twice as wide. Ground tells of such a border
    that is half as wide and was known before the change, or is as wide: at the edge of a lane, cells are driven for
    the first time after it.

    Trucks that keep to a lane make a narrower strip known: what is not known beside it, before the change and after,
    speaks neither for the change nor against it, as long as the strip changed over size_m of its length. Where a part
    of a change is believed, so are cells of its kind that hang together with it, but not beside those that say no.
    """
    edge = _edge(cell_m, config)
    changed, kind = cuts_of.first > 0, cuts_of.kind
    whole = np.rint(np.where(changed, kind, np.nan))
    near, agrees = np.zeros((2, *changed.shape), np.bool_)
    for one in np.unique(whole[np.isfinite(whole)]):
        alike = ~changed & (np.abs(cells.kind - one) <= tuning.alike_bins)
        beside_ns = np.where(_opened(alike, edge), -np.inf, cells.from_ns)
        near |= (whole == one) & (_least(beside_ns, _opened(alike, -(-edge // 2)), 2 * edge) <= cuts_of.old_ns)
        agrees |= alike & _grown(whole == one, edge)
    new = changed & np.isfinite(kind) & ~near
    old_ns, new_ns = -_least(-cuts_of.old_ns, changed, edge), _least(cuts_of.new_ns, changed, edge)
    against = ~changed & ~agrees & (cells.from_ns <= old_ns) & (cells.until_ns >= new_ns)
    believed = _opened(changed, 2 * edge) | _opened(new, edge) | _strips(new, ~changed & ~against, edge, tuning.share)
    out, untouched = believed.copy(), changed & ~_grown(against, 1)
    for one in np.unique(whole[believed & np.isfinite(whole)]):
        alike = untouched & (np.abs(kind - one) <= tuning.alike_bins)
        part = alike & believed & (whole == one)
        for _ in range(2 * edge):  # not further: what a cell shows is to depend on blocks near it alone
            part = alike & _grown(part, 1)
        out |= part
    return out


def reach_blocks(cell_m: float, config: ChangeConfig) -> int:
    """How many blocks away the cells are that `credible` looks at."""
    edge = _edge(cell_m, config)
    # Along what is believed, through a square that is, to ground beside, and through the square that makes it ground.
    return -(-(2 * edge + (edge - 1) + 2 * edge + (edge - 1)) // BLOCK_CELLS)


def _begins_ns(pages: TimedPages) -> Floats:
    return np.array([float(timed.first_ns) for timed in pages])


def _reached(weight: Floats, time_ns: Floats, least_m: float) -> Floats:
    """Time (cells,) of the page at which a cell's votes (pages, cells), summed up, reach what a cut needs; or NaN."""
    if not len(weight):
        return np.full(weight.shape[1], np.nan)
    enough = np.cumsum(weight, axis=0) >= least_m
    return np.where(enough.any(axis=0), time_ns[enough.argmax(axis=0)], np.nan)


def _grown(cells: Bools, reach: int) -> Bools:
    """Cells (rows, columns) that are, or lie so many cells from one that is, or nearer."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), square, borderValue=0) > 0)


def _least(values: Floats, where: Bools, reach: int) -> Floats:
    """Least value (rows, columns) of the cells that lie so many cells away or nearer; infinite where there is none."""
    chosen = np.where(where & ~np.isnan(values), values, np.inf)
    return np.asarray(cv2.erode(chosen, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=np.inf))


def _edge(cell_m: float, config: ChangeConfig) -> int:
    return max(1, round(config.size_m / cell_m))


def _opened(cells: Bools, edge: int) -> Bools:
    """Those that lie in a square of `edge` cells, all of which are set."""
    square, last = np.ones((edge, edge), np.uint8), edge - 1
    # not MORPH_OPEN, which moves what it opens by a cell where the edge is even
    corners = cv2.erode(cells.astype(np.uint8), square, anchor=(0, 0), borderValue=0)
    return np.asarray(cv2.dilate(corners, square, anchor=(last, last), borderValue=0) > 0, np.bool_)


def _strips(cells: Bools, unknown: Bools, edge: int, share: float) -> Bools:
    """Those that lie in a square of `edge` cells which they cross from side to side, and a share of which they are.

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
    corners = fits & crossed & (np.asarray(count) >= share * n**2)
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


def _best_cut(votes: Floats, first: Ints, part: slice, tuning: ChangeTuning) -> tuple[Ints, Floats, Floats]:
    """Index of the page (cells,) at which the ground changed, the given first page where it did not.

    votes: (pages, bins, cells); pages before `first` do not count. Also returns the median (cells,) after it, in bins,
    and by what values the medians differ.
    """
    best, variation, before, after = likeliest_cuts(votes, first, tuning.weight_m)
    is_resistance = part == ev.RESISTANCE
    centres = ev.RESISTANCE_CENTRES if is_resistance else ev.GRADE_CENTRES
    values_before, values_after = (np.interp(median, np.arange(len(centres)), centres) for median in (before, after))
    step = np.abs(values_before - values_after)
    changed = (best > 0) & (variation > tuning.variation) & (np.abs(before - after) >= tuning.bins)
    changed &= step >= (tuning.c_rr if is_resistance else 0.0)
    return np.where(changed, best, first), after, step


def _doubt(pages: TimedPages, packed: NDArray[np.uint64], ends: Ints, cells: Ints, first: Ints, cut: Ints) -> Floats:
    """Standard deviation (cells,) of c_rr after a cut less that before it, by what samples state.

    packed, ends: as of `packed_votes`. More metres of one pass make a side no surer: they err alike, by how an estimate
    settles behind a brake or a bend. Nor do more passes of one machine take off its own share: zero, scale and load.
    """
    weight = weights(packed, ends, ev.RESISTANCE.start, ev.RESISTANCE.stop)[:, cells]
    doubt = weights(packed, ends, ev.DOUBT, ev.DOUBT + 1)[:, cells]
    bits = np.zeros((2, len(pages), ev.CELLS), np.uint64)
    for index, timed in enumerate(pages):
        known = timed.page.cells
        bits[:, index, known["cell"]] = known["visits"], known["machines"]
    page, variance = np.arange(len(pages))[:, None], np.zeros(len(cells))
    for side in ((page >= first) & (page < cut), page >= cut):
        std = ev.DOUBT_MOST * np.where(side, doubt, 0.0).sum(axis=0) / np.where(side, weight, 0.0).sum(axis=0)
        passes, machines = np.bitwise_count(np.bitwise_or.reduce(np.where(side, bits[:, :, cells], 0), axis=1))
        variance += std**2 * (MACHINE_SHARE / machines + (1 - MACHINE_SHARE) / passes)
    return np.sqrt(variance)
