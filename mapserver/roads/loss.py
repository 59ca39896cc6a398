"""What bad ground costs: the work of all passes over a segment, less their work at the target c_rr.

A pass over a slice of length L and slope s loses m g L (max(0, c + s) - max(0, target + s)), at least 0. What brakes
would have absorbed is no loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapserver.error_model import GAP_SHARE, NINETY, PASS_ALIKE_M, resistance_variance
from mapserver.roads.ledger import Ledger, filled, mean, resistance
from mapserver.roads.segments import SegmentTable
from mapserver.roads.tally import PER_C, PER_M, squares_of
from protocol.arrays import Bools, Floats, Ints
from protocol.units import GRAVITY_MPS2

GUESSED_KG = 30_000.0  # assumed if no sample states a mass [kg]: between a loader and a loaded truck


@dataclass(frozen=True)
class Losses:
    """Losses of segments (k,).

    grade: from beginning to end; work_j: with 90 % limits. kg, passes: (k, 2) by direction; guessed: no mass was
    stated; unmeasured: share of slices.
    """

    c_rr: Floats
    c_std: Floats
    grade: Floats
    work_j: Floats
    low_j: Floats
    high_j: Floats
    kg: Floats
    guessed: Bools
    unmeasured: Floats
    passes: Floats


def losses(ledger: Ledger, segments: SegmentTable, target: float, level: Floats | None = None) -> Losses:
    """Losses against a target c_rr. level (k,): replaces c_rr from the wrong side of a repair; NaN keeps it."""
    owner = np.repeat(np.arange(len(segments.ids)), np.diff(ledger.ends))
    metres, weighed, kg_m = (ledger.of_slices(name).astype(np.float64) / PER_M for name in ("metres", "weighed", "kg"))
    known_kg = kg_m.sum() / weighed.sum() if weighed.any() else GUESSED_KG
    segment_kg = by_segment(kg_m, ledger.ends) / np.maximum(by_segment(weighed, ledger.ends), 1e-9)
    guessed = by_segment(weighed, ledger.ends).sum(axis=1) == 0
    segment_kg = np.where(by_segment(weighed, ledger.ends) > 0, segment_kg, known_kg)
    kg = np.where(weighed > 0, kg_m / np.maximum(weighed, 1e-9), segment_kg[owner])
    c, slope = resistance(ledger), slope_of(ledger, segments, owner)
    if level is not None:
        share = level / mean(c, ledger.ends)
        c = c * np.where(np.isfinite(share) & (share > 0), share, 1.0)[owner]
    load = kg * metres * GRAVITY_MPS2  # newton metres per unit of c_rr, all passes
    std = _std(ledger)
    slopes = np.stack([slope, -slope], axis=1)

    def work(shift: Floats) -> Floats:
        ground = np.maximum((c + shift[owner])[:, None], 0.0)
        excess = np.maximum(ground + slopes, 0.0) - np.maximum(target + slopes, 0.0)
        return np.asarray(by_segment((np.maximum(excess, 0.0) * load).sum(axis=1), ledger.ends), np.float64)

    none = np.zeros(len(segments.ids))
    measured = ledger.of_slices("measured").sum(axis=1) > 0
    return Losses(
        c_rr=mean(c, ledger.ends),
        c_std=std,
        grade=mean(slope, ledger.ends),
        work_j=np.nan_to_num(work(none)),
        low_j=np.nan_to_num(work(-NINETY * std)),
        high_j=np.nan_to_num(work(NINETY * std)),
        kg=segment_kg,
        guessed=guessed,
        unmeasured=mean(~measured, ledger.ends),
        passes=by_segment(metres, ledger.ends) / np.maximum(segments.length_m, 1e-9)[:, None],
    )


def by_segment(values: Floats, ends: Ints) -> Floats:
    """Sums (k, ...) over each segment's slices."""
    if not len(values):
        return np.zeros((0, *values.shape[1:]))
    return np.asarray(np.add.reduceat(values, ends[:-1], axis=0), np.float64)


def slope_of(ledger: Ledger, segments: SegmentTable, owner: Ints) -> Floats:
    """Slopes (s,) [m/m] from beginning to end, 0 where unknown."""
    graded = ledger.of_slices("graded").sum(axis=1)
    east, north = (ledger.of_slices(name).sum(axis=1) / np.maximum(graded, 1) / PER_C for name in ("east", "north"))
    along = east * segments.ahead[owner, 0] + north * segments.ahead[owner, 1]
    return np.nan_to_num(filled(np.where(graded > 0, along, np.nan), ledger.ends))


def _std(ledger: Ledger) -> Floats:
    """Deviation (k,) of the mean c_rr; NaN if unmeasured.

    Noise of single passes, common error of all passes, and unmeasured slices.
    """
    measured = ledger.of_slices("measured").sum(axis=1)
    known = measured > 0
    mean_c = ledger.of_slices("c").sum(axis=1) / np.maximum(measured, 1) / PER_C
    variance = np.maximum(
        squares_of(ledger.of_slices("c2").sum(axis=1)) / np.maximum(measured / PER_M, 1e-9) - mean_c**2, 0
    )
    count = np.maximum(np.add.reduceat(known, ledger.ends[:-1]), 1e-9) if len(known) else np.zeros(0)
    within = by_segment(np.where(known, variance, 0.0), ledger.ends) / count
    driven_m = by_segment(measured / PER_M, ledger.ends)
    noise = within / np.maximum(driven_m / PASS_ALIKE_M, 1.0)
    c_rr = mean(resistance(ledger), ledger.ends)
    gaps = 1 - count / np.diff(ledger.ends) if len(known) else count
    gap = gaps * GAP_SHARE * c_rr
    std = np.sqrt(noise + resistance_variance(c_rr) + gap**2)
    return np.asarray(std, np.float64)
