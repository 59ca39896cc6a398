"""Detects ground changes: where recent evidence contradicts older evidence, reads skip the older.

Each cell's evidence is cut between two pages, where two kinds of ground explain it best (log-likelihood ratio of
histograms). The cut is a change if the histograms have little in common (total variation) and the medians differ by
more than machines do and samples state. Later evidence is cut again, so the last change counts.
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
    """When a cut is a change.

    variation: least total variation of histograms, 0 to 1. bins: least difference of medians, in bins (22 % of c_rr,
    0.031 of gradient), the resolution of medians; c_rr: the same on concrete, where machines' biases count (from 0.023
    on bins ask more); sigmas: the same in stated deviations, for sites of hundreds of sections. weight_m: least
    evidence on each side; a vote from a neighbouring cell is no pass. most: changes of a cell. share: of a square of
    size_m that must have changed if the rest is unknown. alike_bins: closer kinds of ground are the same.
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

    detect: on or off. size_m: narrower changes are position errors at a border; so are those below twice this if they
    look like the ground beside.
    """

    detect: bool = True
    size_m: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, ("size_m",))


@dataclass(frozen=True)
class Cuts:
    """Where a block's cells (256,) are cut.

    first: first valid page, 0 for no change. kind: median c_rr after the cut, in bins; NaN if c_rr did not change.
    old_ns, new_ns: begins of the last page before and the first after the cut with evidence, NaN for no change.
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


UNCHANGED = _unchanged()  # shared, because most blocks have no change: 8 KB each


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
    """c_rr of cells (n,) whatever changed.

    kind: median, in bins, NaN if too weak for two sides of a cut. from_ns, until_ns: begins of pages up to which, or
    from which, one side has enough; NaN for never.
    """

    kind: Floats
    from_ns: Floats
    until_ns: Floats


def known(pages: TimedPages, tuning: ChangeTuning = TUNING) -> Known:
    """Knowledge of a block's cells (256,)."""
    packed, ends = pages.packed_votes()
    span = ev.RESISTANCE.start, ev.RESISTANCE.stop
    weight = weights(packed, ends, *span) / ev.WEIGHT_UNITS_PER_M
    median = medians(sums(packed, *span) / ev.WEIGHT_UNITS_PER_M)
    kind = np.where(weight.sum(axis=0) >= 2 * tuning.weight_m, median, np.nan)
    begins_ns, least_m = _begins_ns(pages), tuning.weight_m
    return Known(kind, _reached(weight, begins_ns, least_m), _reached(weight[::-1], begins_ns[::-1], least_m))


def credible(cuts_of: Cuts, cells: Known, cell_m: float, config: ChangeConfig, tuning: ChangeTuning = TUNING) -> Bools:
    """Changed cells (rows, columns) that are no position errors; all values are images.

    Wrong positions carry ground across a border. So a strip counts if it is size_m wide and unlike the ground beside,
    or twice as wide. Ground beside needs half the width if known before the change, else all of it: at a lane's edge,
    cells may be driven only afterwards. Trucks in one lane show narrower strips: what is unknown beside, before and
    after, is neutral if the strip changed along size_m. Cells of the same kind connected to a credible part count,
    except next to contradicting ones.
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
        for _ in range(2 * edge):  # bounded, so that a cell depends on near blocks only
            part = alike & _grown(part, 1)
        out |= part
    return out


def reach_blocks(cell_m: float, config: ChangeConfig) -> int:
    """Blocks around one that `credible` looks at."""
    edge = _edge(cell_m, config)
    # connected cells, the square of a credible one, ground beside, and its square
    return -(-(2 * edge + (edge - 1) + 2 * edge + (edge - 1)) // BLOCK_CELLS)


def _begins_ns(pages: TimedPages) -> Floats:
    return np.array([float(timed.first_ns) for timed in pages])


def _reached(weight: Floats, time_ns: Floats, least_m: float) -> Floats:
    """Begin (cells,) of the page at which summed votes (pages, cells) are enough for a cut; or NaN."""
    if not len(weight):
        return np.full(weight.shape[1], np.nan)
    enough = np.cumsum(weight, axis=0) >= least_m
    return np.where(enough.any(axis=0), time_ns[enough.argmax(axis=0)], np.nan)


def _grown(cells: Bools, reach: int) -> Bools:
    """Dilate by so many cells."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), square, borderValue=0) > 0)


def _least(values: Floats, where: Bools, reach: int) -> Floats:
    """Least value within so many cells; inf for none."""
    chosen = np.where(where & ~np.isnan(values), values, np.inf)
    return np.asarray(cv2.erode(chosen, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=np.inf))


def _edge(cell_m: float, config: ChangeConfig) -> int:
    return max(1, round(config.size_m / cell_m))


def _opened(cells: Bools, edge: int) -> Bools:
    """Cells in a fully set square of `edge` cells."""
    square, last = np.ones((edge, edge), np.uint8), edge - 1
    # not MORPH_OPEN, which shifts by a cell if edge is even
    corners = cv2.erode(cells.astype(np.uint8), square, anchor=(0, 0), borderValue=0)
    return np.asarray(cv2.dilate(corners, square, anchor=(last, last), borderValue=0) > 0, np.bool_)


def _strips(cells: Bools, unknown: Bools, edge: int, share: float) -> Bools:
    """Cells of a square of `edge` cells that they cross and fill to a share; its rest is unknown, like all outside."""
    n, last, wide = edge, edge - 1, [(edge, edge), (edge, edge)]
    some, free = np.pad(cells, wide).astype(np.uint8), np.pad(cells | unknown, wide, constant_values=True)
    crossed: Bools = np.zeros(some.shape, np.bool_)
    for along, across in (((n, 1), (1, n)), ((1, n), (n, 1))):  # a cell in each row, or column
        touched = cv2.dilate(some, np.ones(across, np.uint8), anchor=(0, 0), borderValue=0)
        crossed |= cv2.erode(touched, np.ones(along, np.uint8), anchor=(0, 0), borderValue=0) > 0
    square = np.ones((n, n), np.uint8)
    count = cv2.filter2D(some, cv2.CV_32F, square.astype(np.float32), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    fits = cv2.erode(free.astype(np.uint8), square, anchor=(0, 0), borderValue=0) > 0
    corners = fits & crossed & (np.asarray(count) >= share * n**2)
    opened = cv2.dilate(corners.astype(np.uint8), square, anchor=(last, last), borderValue=0) > 0
    return np.asarray(cells & opened[n:-n, n:-n])


def _histograms(votes: NDArray[np.uint64], ends: Ints, part: slice, cells: Ints) -> Floats:
    """Votes (pages, bins, cells) in metres."""
    columns = np.full(ev.CELLS, -1)
    columns[cells] = np.arange(len(cells))
    counts = np.zeros((len(ends), part.stop - part.start, len(cells)))
    histograms(votes, ends, part.start, part.stop, columns, counts)
    metres: Floats = counts / ev.WEIGHT_UNITS_PER_M
    return metres


def _best_cut(votes: Floats, first: Ints, part: slice, tuning: ChangeTuning) -> tuple[Ints, Floats, Floats]:
    """Page (cells,) of each change, `first` for none; median after it, in bins; and difference of medians.

    votes: (pages, bins, cells); pages before `first` do not count.
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
    """Standard deviation (cells,) of the change of c_rr, as stated by samples.

    packed, ends: as in `packed_votes`. Metres of one pass err alike (settling after a brake or bend), and passes of one
    machine share its bias, scale and load, so neither adds certainty.
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
