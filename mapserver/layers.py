"""Read layers: from evidence to float32 values, NaN where unknown. A new layer is a function and a line in LAYERS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapserver import evidence as ev
from protocol.arrays import AnyArray, Bools, Floats, Floats32
from protocol.errors import QueryError, Refusal
from protocol.ground import BOUNDARIES


@dataclass(frozen=True)
class ReadConfig:
    """How evidence is read. min_weight_m: cells with fewer metres of evidence than this are unknown."""

    min_weight_m: float = 0.1

    def __post_init__(self) -> None:
        if self.min_weight_m < 0:
            raise ValueError("min_weight_m: negative")


Layer = Callable[[ev.Evidence], Floats]


def resistance(evidence: ev.Evidence) -> Floats:
    """Rolling resistance coefficient [-]: robust centre of the votes, in log(c_rr)."""
    centres = np.log(ev.RESISTANCE_CENTRES)
    return np.exp(_robust_centre(evidence.counts[..., ev.RESISTANCE], centres, reach=2))


def resistance_class(evidence: ev.Evidence) -> Floats:
    """Index of the ground class with most votes (0 dry concrete ... 4 sand)."""
    votes = _class_votes(evidence)
    return np.where(votes.sum(axis=-1) > 0, votes.argmax(axis=-1), np.nan)


def confidence(evidence: ev.Evidence) -> Floats:
    """Share of the votes that the leading ground class has."""
    votes = _class_votes(evidence)
    return _ratio(votes.max(axis=-1), votes.sum(axis=-1))


def grade_east(evidence: ev.Evidence) -> Floats:
    """Eastern component of the gradient [m/m], positive where the ground rises to the east."""
    return _robust_centre(evidence.counts[..., ev.GRADE_EAST], ev.GRADE_CENTRES, reach=2)


def grade_north(evidence: ev.Evidence) -> Floats:
    """Northern component of the gradient [m/m], positive where the ground rises to the north."""
    return _robust_centre(evidence.counts[..., ev.GRADE_NORTH], ev.GRADE_CENTRES, reach=2)


def grade(evidence: ev.Evidence) -> Floats:
    """Steepness: length of the gradient [m/m]."""
    return np.hypot(grade_east(evidence), grade_north(evidence))


def visits(evidence: ev.Evidence) -> Floats:
    """How many visits a cell had: linear counting of a 64-bit bitmap (Whang et al. 1990); at most 266."""
    bits = np.bitwise_count(evidence.bitmaps[..., ev.VISITS]).astype(np.float64)
    return np.where(bits > 0, np.rint(-64 * np.log(1 - np.minimum(bits, 63) / 64)), np.nan)


LAYERS: dict[str, Layer] = {
    "resistance": resistance,
    "resistance_class": resistance_class,
    "confidence": confidence,
    "grade_east": grade_east,
    "grade_north": grade_north,
    "grade": grade,
    "visits": visits,
}


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Check layer names; none means all."""
    if unknown := [name for name in names if name not in LAYERS]:
        problem = f"layer `{unknown[0][:40]}` is not known; known: {', '.join(LAYERS)}"
        raise QueryError(Refusal.UNKNOWN_LAYER, problem)
    return tuple(names) or tuple(LAYERS)


def read(evidence: ev.Evidence, names: Sequence[str], config: ReadConfig) -> dict[str, Floats32]:
    """Derive layers, each (blocks, 256), NaN where the evidence is too thin."""
    weight = evidence.counts[..., ev.WEIGHT].astype(np.float64)
    unknown = (weight == 0) | (weight < config.min_weight_m * ev.WEIGHT_UNITS_PER_M)
    return {name: np.where(unknown, np.nan, LAYERS[name](evidence)).astype(np.float32) for name in names}


def _robust_centre(votes: AnyArray, centres: Floats, reach: int) -> Floats:
    """Mean of the votes within `reach` bins of the median bin.

    As robust as the median, and exact where all votes agree, because a vote is split linearly between two bins.
    """
    votes = votes.astype(np.float64)
    total = votes.sum(axis=-1)
    median = (votes.cumsum(axis=-1) >= total[..., None] / 2).argmax(axis=-1)
    near: Bools = np.abs(np.arange(len(centres)) - median[..., None]) <= reach
    kept = np.where(near, votes, 0.0)
    weighted: Floats = np.matmul(kept, centres)
    weight: Floats = kept.sum(axis=-1)
    return _ratio(weighted, weight)


def _class_votes(evidence: ev.Evidence) -> Floats:
    votes: Floats = np.matmul(evidence.counts[..., ev.RESISTANCE].astype(np.float64), _CLASS_OF_BIN)
    return votes


def _class_of_bin() -> Floats:
    """Share (bins, classes) of each bin's width, in log(c_rr), that lies in each class."""
    centres = np.log(ev.RESISTANCE_CENTRES)
    half = (centres[1] - centres[0]) / 2
    edges = np.concatenate([[-np.inf], np.log(BOUNDARIES), [np.inf]])
    low = np.maximum(centres[:, None] - half, edges[None, :-1])
    high = np.minimum(centres[:, None] + half, edges[None, 1:])
    share: Floats = np.maximum(high - low, 0) / (2 * half)
    return share


_CLASS_OF_BIN = _class_of_bin()


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    out: Floats = np.full(denominator.shape, np.nan)
    np.divide(numerator, denominator, out=out, where=denominator > 0)
    return out
