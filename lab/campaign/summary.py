"""From figures by seed to one row of a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from protocol.errors import ConfigError
from sitegrid.proof.figures import Row

Reduce = Callable[[Sequence[float | None]], float]  # values by seed to one value
Figures = Mapping[str, Any]  # of one case and seed: numbers by name; None or NaN: not judged


def mean(values: Sequence[float | None]) -> float:
    """Mean of known values; NaN if none."""
    return float(np.mean(known)) if (known := _known(values)) else math.nan


def median(values: Sequence[float | None]) -> float:
    """Median of known values; NaN if none."""
    return float(np.median(known)) if (known := _known(values)) else math.nan


def strict(reduce: Reduce) -> Reduce:
    """The same, but NaN if any value is unknown."""
    return lambda values: reduce(values) if len(_known(values)) == len(values) else math.nan


def column(by_seed: Sequence[Figures], name: str) -> list[Any]:
    """One figure by seed."""
    return [figures[name] for figures in by_seed]


def summary(named: Row, by_seed: Sequence[Figures], reduce: Reduce = mean, **others: Any) -> Row:
    """A row: case names, figures reduced over seeds, others, and `by_seed`."""
    over = {name: reduce(column(by_seed, name)) for name in by_seed[0]} if by_seed else {}
    return {**named, **over, **others, "by_seed": [dict(figures) for figures in by_seed]}


def chosen(cases: Sequence[Any], names: Sequence[str]) -> tuple[Any, ...]:
    """Cases by name; none: all. ConfigError for unknown names."""
    known = [case.name for case in cases]
    if unknown := [name for name in names if name not in known]:
        raise ConfigError("--cases", f"`{unknown[0][:40]}` is not known; known: {', '.join(known)}")
    return tuple(case for case in cases if not names or case.name in names)


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None and math.isfinite(value)]
