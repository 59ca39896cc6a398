"""Whether stated uncertainty is right: of classes, and of standard deviations.

A forecast states a cell's class and its probability. The server's: leading class with `confidence`; others use the same
samples, each in its stated cell.
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

BINS = 10  # equal bins of confidence
CLIP = 0.001  # bound of confidence: the log score of a certain error is infinite
SIGMAS_95 = 1.96
DIGITS = 4


@dataclass(frozen=True)
class Forecast:
    """Per cell, any shape: class, or UNKNOWN, and probability."""

    kind: Ints
    confidence: Floats

    def judged(self, true: Ints, where: Bools) -> Believed:
        """Known cells among `where`, against true classes."""
        known: Bools = where & (self.kind != UNKNOWN)
        return Believed(self.confidence[known], (self.kind == true)[known])


@dataclass(frozen=True)
class Believed:
    """Of n cells: stated probability of their class, and whether it was right."""

    confidence: Floats
    right: Bools

    @property
    def reliability(self) -> list[Row]:
        """Cells by bins of confidence: number, mean confidence, share right."""
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
        """Expected calibration error: mean distance of confidence from share right."""
        bins = [row for row in self.reliability if row["cells"]]
        off = [row["cells"] * abs(row["said"] - row["right"]) for row in bins]
        return float(sum(off)) / max(1, len(self.right))

    @property
    def brier(self) -> float:
        """Brier score: mean squared error of confidence; lower is better."""
        return float(((self.confidence - self.right) ** 2).mean()) if len(self.right) else math.nan

    @property
    def log_score(self) -> float:
        """Log score: mean negative log-likelihood of the outcome; lower is better."""
        said = np.clip(self.confidence, CLIP, 1 - CLIP)
        return float(-np.log(np.where(self.right, said, 1 - said)).mean()) if len(self.right) else math.nan


def pooled(parts: Sequence[Believed]) -> Believed:
    """Cells of several maps."""
    return Believed(np.concatenate([p.confidence for p in parts]), np.concatenate([p.right for p in parts]))


def by_frequency(hits: Hits) -> Forecast:
    """Class of each cell's newest value, with its share of values as probability."""
    newest = resistance_class(last_write(hits))
    same = (resistance_class(hits.value) == newest[hits.cell]).astype(np.float64)
    count, alike = np.bincount(hits.cell, minlength=hits.cells), np.bincount(hits.cell, same, hits.cells)
    return Forecast(newest, alike / np.maximum(count, 1))


def by_mean(hits: Hits) -> Forecast:
    """Class of the mean, with probability by a normal distribution of the scatter and stated errors."""
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
    """Share [%] of errors in the 95 % interval of a normal distribution; NaN ignored."""
    known = np.isfinite(error) & np.isfinite(std)
    if not known.any():
        return math.nan
    return 100.0 * float((np.abs(error[known]) <= SIGMAS_95 * std[known]).mean())


def forecast_row(named: Row, believed: Believed) -> Row:
    """Figures of a forecast."""
    figures = {name: getattr(believed, name) for name in ("calibration_error", "brier", "log_score")}
    return rounded({**named, "cells": len(believed.right), **figures, "reliability": believed.reliability}, DIGITS)


def layers_forecast(layers: Mapping[str, AnyArray]) -> Forecast:
    """The server's forecast: `resistance_class` and `confidence`."""
    kind = layers["resistance_class"]
    known = np.isfinite(kind)
    classes = np.where(known, kind, UNKNOWN).astype(np.int64)
    return Forecast(classes, np.where(known, layers["confidence"], 0.0).astype(np.float64))
