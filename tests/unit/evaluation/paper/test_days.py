"""Two days of fleets whose ground and errors are known."""

import numpy as np
import pytest

from evaluation.campaign.figures import judge
from evaluation.paper.days import ALONE, BOTH, DAY_NS, FIRST, GOALS, Days, _moved, day_rows, second_day
from tests.unit.evaluation.fleet.scenes import made_scene


def days(net_m: tuple[float, float], wrong_pct: dict[str, float]) -> Days:
    figures = {
        name: {"wrong_resistance_pct": pct, "wrong_grade_pct": 0.1, "known_pct": 100.0 - pct}
        for name, pct in wrong_pct.items()
    }
    return Days(list(net_m), figures)


PAIRS = [
    days((1.0, 2.0), {FIRST: 3.0, ALONE: 2.0, BOTH: 2.5}),
    days((1.2, 1.6), {FIRST: 3.0, ALONE: 2.0, BOTH: 2.1}),
]


def test_the_map_of_both_days_is_compared_with_that_of_the_second_alone():
    first, alone, both = day_rows({"scenario": "paper_site"}, PAIRS)
    assert [row["samples"] for row in (first, alone, both)] == [FIRST, ALONE, BOTH]
    assert [row["net_m"] for row in (first, alone, both)] == [1.1, 1.8, 1.8]
    assert (both["wrong_resistance_pct"], both["worse_wrong_resistance_pct"]) == (2.3, 0.3)
    assert (both["known_pct"], both["worse_known_pct"]) == (97.7, 0.3)
    assert first["worse_wrong_resistance_pct"] is alone["worse_known_pct"] is None
    assert both["ci95"]["wrong_resistance_pct"] == pytest.approx(12.7062 * 0.2, abs=1e-4)


def test_goals_judge_what_is_worse_and_not_what_is_better():
    better = [days((1.0, 1.0), {FIRST: 3.0, ALONE: 2.0, BOTH: 1.0})]
    assert [row["met"] for row in judge(GOALS, day_rows({}, PAIRS))] == [False, True, False]
    assert [row["value"] for row in judge(GOALS, day_rows({}, better))] == [0.0, 0.0, 0.0]


def test_the_second_day_is_a_day_later():
    rows, _ = made_scene()
    later = rows["b"].copy()
    later["stamp_ns"] += 5
    moved = _moved(later, rows["a"])
    assert moved["stamp_ns"][0] == rows["a"]["stamp_ns"][0] + DAY_NS
    np.testing.assert_array_equal(np.diff(moved["stamp_ns"]), np.diff(later["stamp_ns"]))
    assert later["stamp_ns"][0] == rows["b"]["stamp_ns"][0] + 5


@pytest.mark.slow
def test_the_same_drive_again_makes_no_map_worse():
    rows, true = made_scene()
    made = second_day((rows, true), (rows, true))
    assert made.net_m == [pytest.approx(0.0)] * 2
    assert made.figures[FIRST] == made.figures[ALONE]
    assert made.figures[BOTH]["wrong_resistance_pct"] <= made.figures[ALONE]["wrong_resistance_pct"] + 0.5
    assert made.figures[BOTH]["known_pct"] >= made.figures[ALONE]["known_pct"]
