"""Goals: what a figure of a row should be, and whether it is so."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Relation = Literal["<=", ">="]


@dataclass(frozen=True)
class Goal:
    """A limit for one figure of the rows that have these values.

    A figure that must not exceed its limit counts by its size, so that a bias may be negative.
    """

    row: Mapping[str, Any]
    figure: str
    relation: Relation
    limit: float

    def is_met(self, value: float | None) -> bool:
        """Whether a value keeps the limit; what is not known (None, NaN) does not."""
        if value is None:
            return False
        return bool(abs(value) <= self.limit if self.relation == "<=" else value >= self.limit)


@dataclass(frozen=True)
class GoalResult:
    """A goal as reports show it. row: the values that choose it; name: of the figure, which is `value`."""

    row: str
    name: str
    goal: str
    value: float | None
    met: bool


def judge(goals: Sequence[Goal], rows: Sequence[object]) -> list[GoalResult]:
    """Compare rows with the goals that concern them."""
    results = []
    for goal in goals:
        for value in (getattr(row, goal.figure) for row in select(rows, goal.row)):
            label = " ".join(map(str, goal.row.values()))
            limit = f"{goal.relation} {goal.limit:g}"
            results.append(GoalResult(label, goal.figure, limit, value, goal.is_met(value)))
    return results


def select(rows: Iterable[Any], values: Mapping[str, Any]) -> list[Any]:
    """The rows that have these values."""
    return [row for row in rows if all(getattr(row, name) == value for name, value in values.items())]
