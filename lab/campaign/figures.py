"""Rows and goals of experiments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sitegrid.proof.figures import Row


@dataclass(frozen=True)
class Goal:
    """Limit of one figure for the rows with these values.

    Upper limits apply to the absolute value, because a bias may be negative.
    """

    row: Mapping[str, Any]
    figure: str
    relation: Literal["<=", ">="]
    limit: float

    def is_met(self, value: float | None) -> bool:
        """Whether a value keeps the limit; unknown ones (None, NaN) do not."""
        if value is None:
            return False
        return bool(abs(value) <= self.limit if self.relation == "<=" else value >= self.limit)


def judge(goals: Sequence[Goal], rows: Sequence[Row]) -> list[Row]:
    """Judge rows by their goals; `name`: of the figure.

    `row`: the selecting values, plus names that distinguish rows selected together.
    """
    out = []
    for goal in goals:
        chosen = select(rows, goal.row)
        apart = [key for key, value in chosen[0].items() if isinstance(value, str)] if len(chosen) > 1 else []
        apart = [key for key in apart if len({row[key] for row in chosen}) > 1]
        for row in chosen:
            named = (*goal.row.values(), *(row[key] for key in apart))
            value, limit = row[goal.figure], f"{goal.relation} {goal.limit:g}"
            met = goal.is_met(value)
            out.append(
                {"row": " ".join(map(str, named)), "name": goal.figure, "goal": limit, "value": value, "met": met}
            )
    return out


def select(rows: Iterable[Row], values: Mapping[str, Any]) -> list[Row]:
    """Rows with these values."""
    return [row for row in rows if values.items() <= row.items()]
