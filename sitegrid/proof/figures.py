"""Report rows: plain values, shared statistics, rounding. JSON prints reports as they are."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from scipy import stats

from protocol.arrays import Floats

CONFIDENCE = 0.95
Value = TypeVar("Value")
Row = dict[str, Any]  # plain values by name
Report = dict[str, Any]  # the same, and lists of rows


def root_mean_square(values: Floats) -> float:
    """Root mean square; NaN if empty."""
    return float(np.sqrt((values**2).mean())) if len(values) else math.nan


def half_width(sample: Floats) -> float | None:
    """Half-width of a mean's 95 % interval (Student's t); None for one value."""
    n = len(sample)
    if n < 2:
        return None
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1))
    return quantile * float(sample.std(ddof=1)) / math.sqrt(n)


def rounded(value: Value, digits: int, **other_digits: int) -> Value:
    """Round all floats, in lists and rows too; other_digits: by name."""
    out: Any = value
    if isinstance(value, float):
        out = round(value, digits)
    elif isinstance(value, list):
        out = [rounded(inner, digits) for inner in value]
    elif isinstance(value, dict):
        out = {name: rounded(inner, other_digits.get(name, digits)) for name, inner in value.items()}
    result: Value = out
    return result
