"""Cases that wait for the night, because they seldom fail alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def by_night(cases: Iterable[Any], day: Iterable[Any] = ()) -> list[Any]:
    """Cases for parametrize; `make test` runs only those of `day`."""
    by_day = list(day)
    return [case if case in by_day else _at_night(case) for case in cases]


def _at_night(case: Any) -> Any:
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.nightly)
