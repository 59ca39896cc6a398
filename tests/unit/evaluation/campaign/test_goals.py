import math
from dataclasses import dataclass

import pytest

from evaluation.campaign.goals import Goal, GoalResult, judge


@dataclass
class Row:
    method: str
    passes: int | None
    wrong_pct: float | None


@pytest.mark.parametrize(
    ("relation", "value", "met"),
    [
        ("<=", 0.4, True),
        ("<=", 0.41, False),
        ("<=", -0.4, True),
        ("<=", -0.41, False),  # a bias counts by its size
        (">=", 0.4, True),
        (">=", 0.39, False),
        ("<=", None, False),
        (">=", None, False),
        ("<=", math.nan, False),
        (">=", math.nan, False),
    ],
)
def test_a_goal_is_met_up_to_its_limit_and_never_by_what_is_not_known(relation, value, met):
    assert Goal({}, "wrong_pct", relation, 0.4).is_met(value) is met


def test_goals_concern_the_rows_that_have_their_values():
    rows = [Row("mean", 1, 0.2), Row("mean", 2, 0.5), Row("median", 1, None)]
    goals = [
        Goal({"method": "mean", "passes": 2}, "wrong_pct", "<=", 0.4),
        Goal({"passes": 1}, "wrong_pct", "<=", 0.4),
        Goal({"method": "kalman"}, "wrong_pct", "<=", 0.4),
    ]
    assert judge(goals, rows) == [
        GoalResult("mean 2", "wrong_pct", "<= 0.4", 0.5, met=False),
        GoalResult("1", "wrong_pct", "<= 0.4", 0.2, met=True),
        GoalResult("1", "wrong_pct", "<= 0.4", None, met=False),
    ]
