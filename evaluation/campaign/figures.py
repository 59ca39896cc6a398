"""Figures of reports: what many of them need, and their rounding."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy import stats

from protocol.arrays import Floats

CONFIDENCE = 0.95
Value = TypeVar("Value")


def half_width(sample: Floats) -> float | None:
    """Half-width of the 95 % interval of a mean, by Student's t; None of a single value."""
    n = len(sample)
    if n < 2:
        return None
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1))
    return quantile * float(sample.std(ddof=1)) / math.sqrt(n)


def root_mean_square(values: Floats) -> float:
    """Root mean square, NaN of nothing."""
    return float(np.sqrt((values**2).mean())) if len(values) else math.nan


def rounded(value: Value, digits: int, **other_digits: int) -> Value:
    """Round every float in a value, in lists and dataclasses too; other_digits: of a dataclass's fields by name."""
    out: Any = value
    if isinstance(value, float):
        out = round(value, digits)
    elif isinstance(value, list):
        out = [rounded(inner, digits) for inner in value]
    elif is_dataclass(value) and not isinstance(value, type):
        changes = {f.name: rounded(getattr(value, f.name), other_digits.get(f.name, digits)) for f in fields(value)}
        out = replace(value, **changes)
    result: Value = out
    return result
