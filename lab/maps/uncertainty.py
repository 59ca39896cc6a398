"""Whether a map can be believed where it says how sure it is: of classes, and of standard deviations.

A forecast says of a cell which class it has, and how likely that is. The server's is its leading class with
`confidence`; the others are made of the same samples, each in the one cell of its stated place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from lab.maps.methods import Hits, last_write, mean
from protocol.arrays import AnyArray, Bools, Floats, Ints
from protocol.site.ground_classes import BOUNDARIES, UNKNOWN, resistance_class
from sitegrid.proof.figures import Row, rounded

BINS = 10  # of confidence, equally wide
CLIP = 0.001  # nobody is surer than that: the logarithmic score of a certain error would be infinite
SIGMAS_95 = 1.96
DIGITS = 4


@dataclass(frozen=True)
class Forecast:
    """Of cells, in an array of any shape: class, UNKNOWN where there is none, and how likely it is, 0 to 1."""

    kind: Ints
    confidence: Floats

    def judged(self, true: Ints, where: Bools) -> Believed:
        """Its known cells among some of them, against true classes."""
        known: Bools = where & (self.kind != UNKNOWN)
        return Believed(self.confidence[known], (self.kind == true)[known])


@dataclass(frozen=True)
class Believed:
    """Of n cells: how likely their class was said to be, and whether it was right."""

    confidence: Floats
    right: Bools

    @property
    def reliability(self) -> list[Row]:
        """Cells by confidence, in bins: how many, mean confidence, and share that is right."""
        which = np.minimum((self.confidence * BINS).astype(np.int64), BINS - 1)
        rows = []
        for i in range(BINS):
            said, right = self.confidence[which == i], self.right[which == i]
            means = [float(values.mean()) if len(values) else None for values in (said, right)]
            edges = {"from": i / BINS, "to": (i + 1) / BINS}
            rows.append({**edges, "cells": len(said), "said": means[0], "right": means[1]})
        return rows

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean distance between what was said and what was right, over cells."""
        bins = [row for row in self.reliability if row["cells"]]
        off = [row["cells"] * abs(row["said"] - row["right"]) for row in bins]
        return float(sum(off)) / max(1, len(self.right))

    @property
    def brier(self) -> float:
        """Mean square of confidence minus 1 where the class is right, minus 0 where not; the less the better."""
        return float(((self.confidence - self.right) ** 2).mean()) if len(self.right) else math.nan

    @property
    def log_score(self) -> float:
        """Mean of minus the logarithm of the likelihood of what was so; the less the better."""
        said = np.clip(self.confidence, CLIP, 1 - CLIP)
        return float(-np.log(np.where(self.right, said, 1 - said)).mean()) if len(self.right) else math.nan


def pooled(parts: Sequence[Believed]) -> Believed:
    """Cells of several maps."""
    return Believed(np.concatenate([p.confidence for p in parts]), np.concatenate([p.right for p in parts]))


def by_frequency(hits: Hits) -> Forecast:
    """The class of the newest value of each cell, as likely as its share of all values there."""
    newest = resistance_class(last_write(hits))
    same = (resistance_class(hits.value) == newest[hits.cell]).astype(np.float64)
    count, alike = np.bincount(hits.cell, minlength=hits.cells), np.bincount(hits.cell, same, hits.cells)
    return Forecast(newest, alike / np.maximum(count, 1))


def by_mean(hits: Hits) -> Forecast:
    """The class of the mean, as likely as a normal distribution has it that is as wide as values and their errors."""
    parts = (hits.value, hits.value**2, hits.variance)
    middle, square, stated = (mean(replace(hits, value=part)) for part in parts)
    known = np.isfinite(middle)
    std = np.sqrt(np.maximum(square - middle**2, 0.0) + stated)
    kind = resistance_class(middle)
    edges = np.array([-np.inf, *BOUNDARIES, np.inf])
    low, high = edges[np.maximum(kind, 0)], edges[np.maximum(kind, 0) + 1]
    with np.errstate(invalid="ignore"):
        likely = ndtr((high - middle) / std) - ndtr((low - middle) / std)
    return Forecast(kind, np.where(known, likely, 0.0))


def coverage_pct(error: AnyArray, std: AnyArray) -> float:
    """Share of errors within the 95 % interval of a normal distribution of so much deviation [%]; NaN ones drop out."""
    known = np.isfinite(error) & np.isfinite(std)
    if not known.any():
        return math.nan
    return 100.0 * float((np.abs(error[known]) <= SIGMAS_95 * std[known]).mean())


def forecast_row(named: Row, believed: Believed) -> Row:
    """The figures of a forecast."""
    figures = {name: getattr(believed, name) for name in ("calibration_error", "brier", "log_score")}
    return rounded({**named, "cells": len(believed.right), **figures, "reliability": believed.reliability}, DIGITS)


def layers_forecast(layers: Mapping[str, AnyArray]) -> Forecast:
    """The server's: `resistance_class` and `confidence`."""
    kind = layers["resistance_class"]
    known = np.isfinite(kind)
    classes = np.where(known, kind, UNKNOWN).astype(np.int64)
    return Forecast(classes, np.where(known, layers["confidence"], 0.0).astype(np.float64))
