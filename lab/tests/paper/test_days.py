"""Two days of fleets whose ground and errors are known."""

import numpy as np
import pytest

from lab.paper import days as days_module
from lab.paper.days import (
    ALONE,
    BOTH,
    DAY_NS,
    FIRST,
    GOALS,
    Day,
    Days,
    as_others,
    day_rows,
    halves,
    judged_days,
)
from lab.tests.fleet.scenes import made_scene
from sitegrid.proof.figures import judge


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


@pytest.fixture(scope="module")
def day() -> Day:
    return Day(*made_scene())


def test_halves_are_two_days_of_the_same_machines(day: Day):
    first, second = halves(day)
    for name, rows in day.rows.items():
        assert len(first.rows[name]) + len(second.rows[name]) == len(rows)
        assert (first.true.tracks[name].stamp_ns[-1:] < second.true.tracks[name].stamp_ns[:1]).all()
        assert set(second.rows[name]["stamp_ns"]) <= set(second.true.tracks[name].stamp_ns)
    assert all(len(rows) for half in (first, second) for rows in half.rows.values())


def test_others_have_other_names_and_the_same_truth(day: Day):
    others = as_others(day)
    assert others.rows.keys() == others.true.tracks.keys()
    assert not others.rows.keys() & day.rows.keys()
    assert others.true.truth is day.true.truth


@pytest.mark.slow
def test_the_second_day_is_a_day_later_and_makes_no_map_worse(day: Day, monkeypatch: pytest.MonkeyPatch):
    asked: list[dict] = []
    judge_map = days_module.judged
    monkeypatch.setattr(days_module, "judged", lambda rows, true: (asked.append(rows), judge_map(rows, true))[1])
    made = judged_days(day, as_others(day))
    assert made.net_m == [pytest.approx(0.0)] * 2
    assert made.figures[BOTH]["wrong_resistance_pct"] <= made.figures[ALONE]["wrong_resistance_pct"] + 0.5
    assert made.figures[BOTH]["known_pct"] >= made.figures[ALONE]["known_pct"]
    both = asked[2]
    assert both["b-other"]["stamp_ns"][0] - both["b"]["stamp_ns"][0] == DAY_NS
    assert len(asked[0]["b"]) == len(asked[1]["b-other"]) == len(both["b"])


@pytest.mark.slow
def test_a_night_between_halves_of_a_drive_moves_the_later_samples_alone(day: Day, monkeypatch: pytest.MonkeyPatch):
    asked: list[dict] = []
    monkeypatch.setattr(days_module, "judged", lambda rows, _: (asked.append(rows), PAIRS[0].figures[FIRST])[1])
    first, second = halves(day)
    judged_days(first, second)
    both = asked[2]["a"]["stamp_ns"]
    assert (np.diff(both) > 0).all()
    assert np.diff(both).max() > DAY_NS / 2
    assert len(both) == len(day.rows["a"])
