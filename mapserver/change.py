"""Change of the ground: where recent evidence contradicts older evidence, the older is left out when the map is read.

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

from mapserver import evidence as ev
from mapserver.ladder import TimedPage
from protocol.arrays import AnyArray, Bools, Floats, Ints
from protocol.config import require_positive

MOST_CHANGES = 4  # of one cell, in all that its pages remember
ALIKE_BINS = 1.0  # cells whose pages' means differ by less are not looked at any closer
_PARTS = (ev.RESISTANCE, ev.GRADE_EAST, ev.GRADE_NORTH)


@dataclass(frozen=True)
class ChangeConfig:
    """When recent evidence replaces older evidence.

    detect: whether it ever does. variation: total variation between the two [0..1] above which they contradict each
    other. bins: least difference of their medians, in bins of votes (22 % of c_rr, 0.031 of gradient). weight_m: least
    evidence on either side. size_m: changes narrower than this are position errors at a border.
    """

    detect: bool = True
    variation: float = 0.6
    bins: float = 1.5
    weight_m: float = 0.3
    size_m: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, ("bins", "weight_m", "size_m"))
        if not 0 < self.variation < 1:
            raise ValueError(f"variation: {self.variation} is not between 0 and 1")


def first_valid(pages: Sequence[TimedPage], config: ChangeConfig) -> Ints:
    """For each cell (256,) of a block: index of the first page that holds for the ground as it is now."""
    first = np.zeros(ev.CELLS, np.int64)
    if len(pages) < 2 or not config.detect:
        return first
    histograms = _histograms(pages)
    for part in _PARTS:
        votes = histograms[:, part]
        cells = np.flatnonzero(_may_differ(votes, config.weight_m))
        for _ in range(MOST_CHANGES):
            if not len(cells):
                break
            cut = _best_cut(votes[:, :, cells], first[cells], config)
            changed = cut > first[cells]
            first[cells] = np.maximum(first[cells], cut)
            cells = cells[changed]
    return first


def without_thin(changed: Bools, cell_m: float, config: ChangeConfig) -> Bools:
    """Cells (rows, columns) that lie in a changed area of at least size_m across: opening by a square of that size."""
    edge = max(1, round(config.size_m / cell_m))
    square = np.ones((edge, edge), np.uint8)
    opened = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, square, borderValue=0)
    return np.asarray(opened > 0, np.bool_)


def _histograms(pages: Sequence[TimedPage]) -> AnyArray:
    """Votes (pages, COUNTS, 256) in metres."""
    counts = np.zeros((len(pages), ev.COUNTS * ev.CELLS), np.float32)
    for i, timed in enumerate(pages):
        votes = timed.page.votes
        counts[i][votes["place"]] = votes["count"]
    metres = counts.reshape(len(pages), ev.COUNTS, ev.CELLS) / np.float32(ev.WEIGHT_UNITS_PER_M)
    return np.asarray(metres)


def _may_differ(votes: Floats, weight_m: float) -> Bools:
    """Cells whose pages' mean bins differ at all: most do not, and are not looked at any closer."""
    weight = votes.sum(axis=1)
    mean = np.tensordot(np.arange(votes.shape[1], dtype=np.float32), votes, (0, 1)) / np.maximum(weight, 1e-9)
    seen = weight > 0.1 * weight_m
    spread = np.where(seen, mean, -np.inf).max(axis=0) - np.where(seen, mean, np.inf).min(axis=0)
    return np.asarray(spread > ALIKE_BINS, np.bool_)


def _best_cut(votes: Floats, first: Ints, config: ChangeConfig) -> Ints:
    """Index of the page (cells,) at which the ground changed, the given first page where it did not.

    votes: (pages, bins, cells); pages before `first` are left out.
    """
    pages = np.arange(len(votes))
    kept = np.where(pages[:, None, None] >= first, votes, 0)
    until = kept.cumsum(axis=0)
    old, new = until[:-1], until[-1] - until[:-1]  # (pages - 1, bins, cells): cut before page 1, 2, ...
    likelihood = _entropy(until[-1])[None] - _entropy(old) - _entropy(new)
    weights = np.minimum(old.sum(axis=1), new.sum(axis=1))
    likelihood[weights < config.weight_m] = -np.inf
    best = likelihood.argmax(axis=0)
    cells = np.arange(votes.shape[2])
    before, after = old[best, :, cells].T, new[best, :, cells].T  # (bins, cells)
    share_before, share_after = (part / np.maximum(part.sum(axis=0), 1e-9) for part in (before, after))
    variation = np.abs(share_before - share_after).sum(axis=0) / 2
    apart = np.abs(_median(share_before) - _median(share_after))
    changed = (weights[best, cells] >= config.weight_m) & (variation > config.variation) & (apart >= config.bins)
    return np.where(changed, best + 1, first)


def _entropy(votes: Floats) -> Floats:
    """Weight times entropy (...,) of histograms (..., bins, cells), in metres times nats."""
    weight = votes.sum(axis=-2)
    logs = votes * np.log(np.maximum(votes, 1e-12))
    return np.asarray(weight * np.log(np.maximum(weight, 1e-12)) - logs.sum(axis=-2), np.float64)


def _median(shares: Floats) -> Floats:
    """Median (cells,) of histograms (bins, cells) in bins, between the bins where it lies between."""
    until = shares.cumsum(axis=0)
    bin_ = (until >= 0.5).argmax(axis=0)
    cells = np.arange(shares.shape[1])
    inside = np.maximum(shares[bin_, cells], 1e-9)
    return np.asarray(bin_ + 0.5 - (until[bin_, cells] - 0.5) / inside, np.float64)
