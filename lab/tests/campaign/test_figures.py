"""Figures of experiments: intervals over seeds, goals."""

import math

import numpy as np
import pytest

from lab.campaign.figures import Goal, judge
from sitegrid.proof.figures import half_width


def test_interval_of_a_mean_holds_it_19_times_in_20():
    samples = np.random.default_rng(5).normal(3.0, 1.0, (1000, 6))
    held = [abs(s.mean() - 3.0) <= (half_width(s) or 0) for s in samples]
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)
    assert half_width(np.ones(1)) is None


@pytest.mark.parametrize("value", [0.4, -0.4, 0.41, -0.41, 0.39, None, math.nan])
def test_a_goal_is_met_up_to_its_limit_and_never_by_what_is_not_known(value):
    """A bias counts by its absolute value."""
    assert Goal({}, "wrong_pct", "<=", 0.4).is_met(value) is (value in (0.4, -0.4, 0.39))
    assert Goal({}, "wrong_pct", ">=", 0.4).is_met(value) is (value in (0.4, 0.41))


def test_goals_concern_the_rows_that_have_their_values():
    rows = [
        {"method": method, "passes": passes, "wrong_pct": wrong}
        for method, passes, wrong in (("mean", 1, 0.2), ("mean", 2, 0.5), ("median", 1, None))
    ]
    chosen = ({"method": "mean", "passes": 2}, {"passes": 1}, {"method": "kalman"})
    results = judge([Goal(row, "wrong_pct", "<=", 0.4) for row in chosen], rows)
    shared = {"name": "wrong_pct", "goal": "<= 0.4"}
    assert results == [
        {"row": "mean 2", **shared, "value": 0.5, "met": False},
        {"row": "1 mean", **shared, "value": 0.2, "met": True},
        {"row": "1 median", **shared, "value": None, "met": False},
    ]
