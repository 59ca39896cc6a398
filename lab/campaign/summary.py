"""From figures of a case, seed by seed, to one row of a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from protocol.errors import ConfigError
from sitegrid.proof.figures import Row

Reduce = Callable[[Sequence[float | None]], float]  # from the seeds' values to one
Figures = Mapping[str, Any]  # of one case and seed: numbers by name, None or NaN where nothing was to be judged


def mean(values: Sequence[float | None]) -> float:
    """Mean of the values that are known; NaN where none is."""
    return float(np.mean(known)) if (known := _known(values)) else math.nan


def median(values: Sequence[float | None]) -> float:
    """Median of the values that are known; NaN where none is."""
    return float(np.median(known)) if (known := _known(values)) else math.nan


def strict(reduce: Reduce) -> Reduce:
    """The same; NaN where any value is not known."""
    return lambda values: reduce(values) if len(_known(values)) == len(values) else math.nan


def column(by_seed: Sequence[Figures], name: str) -> list[Any]:
    """A figure, seed by seed."""
    return [figures[name] for figures in by_seed]


def summary(named: Row, by_seed: Sequence[Figures], reduce: Reduce = mean, **others: Any) -> Row:
    """A row: what names the case, each figure over the seeds, others, and `by_seed`, what each seed gave."""
    over = {name: reduce(column(by_seed, name)) for name in by_seed[0]} if by_seed else {}
    return {**named, **over, **others, "by_seed": [dict(figures) for figures in by_seed]}


def chosen(cases: Sequence[Any], names: Sequence[str]) -> tuple[Any, ...]:
    """Cases of these names; none means all. ConfigError names one that is not known."""
    known = [case.name for case in cases]
    if unknown := [name for name in names if name not in known]:
        raise ConfigError("--cases", f"`{unknown[0][:40]}` is not known; known: {', '.join(known)}")
    return tuple(case for case in cases if not names or case.name in names)


def _known(values: Sequence[float | None]) -> list[float]:
    return [value for value in values if value is not None and math.isfinite(value)]
