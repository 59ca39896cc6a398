"""Figures of reports: intervals, rounding, goals."""

import math

import numpy as np
import pytest

from sitegrid.proof.figures import Goal, half_width, judge, root_mean_square, rounded


def test_interval_of_a_mean_holds_it_19_times_in_20():
    samples = np.random.default_rng(5).normal(3.0, 1.0, (1000, 6))
    held = [abs(s.mean() - 3.0) <= (half_width(s) or 0) for s in samples]
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)
    assert half_width(np.ones(1)) is None


def test_root_mean_square_of_nothing_is_not_known():
    assert root_mean_square(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(root_mean_square(np.empty(0)))


def test_rounding_reaches_every_float_and_leaves_the_rest():
    row = {"name": "a", "count": 12345, "met": True, "net_m": 1.23456, "max_m": None, "reasons": {"gap": 2}}
    inner = {"by_seed": [0.11111, math.inf], "parts": [{"share": 2 / 3}]}
    expected = {"net_m": 1.23, "by_seed": [0.1111, math.inf], "parts": [{"share": 0.67}]}
    assert rounded({**row, **inner}, 2, by_seed=4) == {**row, **expected}
    assert rounded(row, 2)["met"] is True


@pytest.mark.parametrize("value", [0.4, -0.4, 0.41, -0.41, 0.39, None, math.nan])
def test_a_goal_is_met_up_to_its_limit_and_never_by_what_is_not_known(value):
    """A bias counts by its size."""
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
