"""Report of cooperation: rows of synthetic figures, goals, refusals."""

import numpy as np
import pytest

from lab.cooperation.experiment import Outcome, Plan, report
from lab.cooperation.live import LiveRun
from lab.cooperation.network import FIGURES
from lab.cooperation.scores import Judging, Scored
from lab.tests.cooperation.samples import driving

SEEDS = (0, 1)
MINUTES = np.arange(1.0, 31.0)
PLAN = Plan.full(SEEDS)


def scored(arm, *, share_per_min: float, central: bool = False) -> Scored:
    """Figures of an arm with linear coverage."""
    over_time = np.zeros((len(MINUTES), len(FIGURES)))
    over_time[:, 0] = np.minimum(100.0, share_per_min * MINUTES)
    figures = dict.fromkeys(FIGURES, 5.0)
    driven = dict.fromkeys(("driven_wrong_pct", "driven_slope_wrong_pct", "driven_known_pct", "places_c_rr_pct"), 1.0)
    rounds = [
        {"rounds": n, "minutes": float(n), **figures, "grade_pct": 0.4 / n, "decided": figures} for n in range(1, 7)
    ]
    grounds = [
        {
            "ground": name,
            "cells": 9,
            "passes": passes,
            "least_passes": 2,
            "minutes": 1.0,
            "arrived_min": 2.5,
            "by_pass_pct": [0.0, 95.0],
            "driven_by_pass_pct": [50.0, 100.0],
        }
        for name, passes in (("shared", 2), ("west", 3))
    ]
    costs = {"cost_pct": -0.02, "let_in_pct": 4.0, "estimated_cost_pct": 0.3, "excluded_min": 3.0, "excluded": ["x"]}
    return Scored(
        minutes=MINUTES,
        by_stamp=over_time,
        by_arrival=np.roll(over_time, 2, axis=0),
        rounds=rounds,
        end={**figures, **driven},
        repaved=grounds if arm.repaves else [],
        spoiled=costs if arm.spoiled else {},
        alarms=0 if central else 1,
        km2_days=0.0 if central else 0.5,
        same_pct=100.0 if central else None,
    )


def live_run(arm) -> LiveRun:
    n = arm.machines
    nothing = np.zeros(0, np.int64)
    names = [f"loader-{i}" for i in range(n)]
    return LiveRun(driving(0, 0), nothing, nothing, names, [], [2_000_000] * n, [1_000] * n, True, 3.0, {})


def outcomes(plan: Plan, shares: dict[str, float]) -> list[Outcome]:
    out = []
    for arm in plan.arms:
        figures = scored(arm, share_per_min=shares.get(arm.name, 20.0))
        out.append(Outcome(Judging(arm), [live_run(arm) for _ in plan.seeds], [figures for _ in plan.seeds]))
    four = next(arm for arm in plan.arms if arm.name == "four")
    central = scored(four, share_per_min=20.0, central=True)
    return [*out, Outcome(Judging(four, central=True), [None for _ in plan.seeds], [central for _ in plan.seeds])]


def test_times_and_speedups_are_paired():
    made = report(PLAN, outcomes(PLAN, {"one": 5.0, "four": 20.0}))
    rows = {row["arm"]: row for row in made["rows"]}
    assert (rows["one"]["minutes"], rows["four"]["minutes"]) == (18.0, 4.5)
    speedups = {row["arm"]: row for row in made["speedups"]}
    assert speedups["four"]["speedup"] == 4.0
    assert speedups["four"]["by_seed"] == [{"speedup": 4.0}] * 2
    assert speedups["one"]["speedup"] == 1.0


def test_an_arm_that_never_covers_enough_has_no_time_and_misses_its_goal():
    made = report(PLAN, outcomes(PLAN, {"four": 2.0}))
    row = next(row for row in made["rows"] if row["arm"] == "four")
    assert np.isnan(row["minutes"])
    (goal,) = [goal for goal in made["goals"] if goal["name"] == "speedup"]
    assert not goal["met"]


def test_every_goal_has_one_row_or_one_for_each_ground():
    goals = report(PLAN, outcomes(PLAN, {"one": 5.0}))["goals"]
    assert [(goal["name"], goal["met"]) for goal in goals] == [
        ("c_rr_pct", True),
        ("speedup", True),
        ("grade_pct", True),
        ("grade_pct", True),
        ("passes", True),
        ("passes", False),
        ("cost_pct", True),
        ("cost_pct", True),
    ]


def test_bytes_are_those_of_one_machine_in_one_hour_of_its_work():
    rows = {row["arm"]: row for row in report(PLAN, outcomes(PLAN, {}))["rows"]}
    four = next(arm for arm in PLAN.arms if arm.name == "four")
    assert rows["four"]["sent_mb_per_h"] == pytest.approx(2.0 * 3600 / four.seconds, abs=1e-4)
    assert rows["four"]["received_mb_per_h"] == pytest.approx(0.001 * 3600 / four.seconds, abs=1e-4)
    assert rows["central"]["sent_mb_per_h"] is None
    assert (rows["central"]["link"], rows["central"]["same_pct"]) == ("perfect", 100.0)
