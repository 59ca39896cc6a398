"""Cases of fleet calibration: tampering, true errors, rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lab.calibration.cases import CASES, RAMP_STEPS, FleetCase, tampered
from lab.calibration.drives import Scene
from lab.calibration.experiment import row_of
from lab.calibration.solving import FIGURES, MAPS, CaseResult, JudgedMap, solved, true_errors
from lab.tests.calibration.scenes import ROUTES, made_scene, track
from protocol.arrays import Table
from tests.unit.mapserver.calibration.drives import RAMP, Errors, drive


@pytest.fixture(scope="module")
def scene() -> tuple[dict[str, Table], Scene]:
    return made_scene()


def case(name: str) -> FleetCase:
    return next(each for each in CASES if each.name == name)


def test_truth_shows_the_errors_of_a_machine(scene) -> None:
    rows, true = scene
    data = tampered(case("machines_3"), rows, true)
    for name, (_, errors) in ROUTES.items():
        (fitted,) = true_errors(data, name, true, 1)
        assert fitted.zero == pytest.approx(errors.zero, abs=0.001), name
        assert fitted.scale == pytest.approx(errors.scale, abs=0.02), name
        assert fitted.across == pytest.approx(errors.across, abs=0.003), name


def test_after_is_better_than_before_and_near_the_oracle(scene) -> None:
    result = solved(case("machines_3"), *scene)
    wrong = {name: each.figures["wrong_pct"] for name, each in result.maps.items()}
    assert wrong["oracle"] <= wrong["after"] + 1.0
    assert wrong["after"] < wrong["before"] / 2
    assert result.common == (True, "")
    assert np.abs(result.zeros).max() < 0.002
    assert np.abs(result.scales).max() < 0.04


@pytest.mark.parametrize("name", ["gain_1.6", "majority_off", "step_at_half"])
def test_faults_that_a_case_adds_are_those_that_the_truth_shows(scene, name: str) -> None:
    rows, true = scene
    chosen, plain = case(name), case("machines_3")
    wrong, right = tampered(chosen, rows, true), tampered(plain, rows, true)
    before = true_errors(right, "b", true, chosen.spans)
    after = true_errors(wrong, "b", true, chosen.spans)
    if name == "gain_1.6":
        assert 1 + after[0].scale == pytest.approx(1.6 * (1 + before[0].scale), abs=0.02)
    else:
        assert after[-1].zero - before[-1].zero == pytest.approx(0.015, abs=0.0005)
        assert (after[0].zero - before[0].zero == pytest.approx(0.0, abs=0.0005)) == (name == "step_at_half")


@pytest.mark.parametrize("step", RAMP_STEPS)
def test_ramps_of_other_ground_leave_the_slope_alone(scene, step: float) -> None:
    rows, true = scene
    chosen = case(f"ramp_of_other_ground_{step:+g}")
    data = tampered(chosen, rows, true)
    steps = np.unique(np.round(data.c_rr - true.truth.c_rr, 4)).tolist()
    assert steps == pytest.approx(sorted([0.0, step]))
    result = solved(chosen, *scene)
    if abs(step) > 0.005:
        assert result.common == (False, "ground_changes_with_slope")
        assert result.maps["after"].figures["slope_pct"] <= result.maps["before"].figures["slope_pct"] + 1.0


def judged_map(*figures: float) -> JudgedMap:
    return JudgedMap(
        dict(zip(FIGURES, figures, strict=True)), *[np.zeros((1, 1), np.int64)] * 2, np.ones((1, 1), np.bool_)
    )


def test_rows_are_means_over_the_seeds() -> None:
    maps = dict.fromkeys(MAPS, judged_map(2.0, 1.0, np.nan))
    one = CaseResult(maps, np.array([0.001]), np.array([0.02]), np.array([1.0, 2.0]), np.array([0.003]), (True, ""), {})
    other = CaseResult(
        {**maps, "after": judged_map(4.0, 1.0, np.nan)},
        np.array([-0.001]),
        np.array([0.0]),
        np.array([0.0, 0.0]),
        np.array([-0.001]),
        (False, "no_slope_both_ways"),
        {"b": "offset"},
    )
    after, before, oracle = (row_of("machines_2", name, [one, other]) for name in ("after", "before", "oracle"))
    assert (after["wrong_pct"], after["max_wrong_pct"]) == (3.0, 4.0)
    assert [figures["wrong_pct"] for figures in after["by_seed"]] == [2.0, 4.0]
    assert (after["rms_zero"], after["rms_scale"], after["normalised"]) == (0.001, 0.0141, 1.25)
    assert (after["common_scale_observed"], after["reasons"]) == (1, ["no_slope_both_ways"])
    assert (after["change_pct"], after["above_before_pct"], after["max_above_oracle_pct"]) == (1.0, 1.0, 2.0)
    assert after["distrusted"] == [{}, {"b": "offset"}]
    assert (before["wrong_pct"], before["change_pct"]) == (2.0, 0.0)
    assert before["rms_zero"] == pytest.approx(np.sqrt(5) * 1e-3, abs=1e-6)
    assert np.isnan([before["rms_scale"], oracle["rms_zero"]]).all()


@pytest.mark.slow
def test_a_bad_machine_is_distrusted_and_the_others_are_as_without_it(scene) -> None:
    rows, true = scene
    d = drive(RAMP, Errors(0.002, 0.6), seed=9, late=False)
    places = {**true.tracks, "bad": track(d)}
    d["y_m"] += 3.0
    with_bad = solved(replace(case("machines_4"), machines=0), {**rows, "bad": d}, Scene(true.truth, places))
    without = solved(case("machines_3"), rows, true)
    assert list(with_bad.distrusted) == ["bad"]
    assert "beyond_data_sheet" in with_bad.distrusted["bad"]
    assert {n: each.figures for n, each in with_bad.maps.items()} == {n: m.figures for n, m in without.maps.items()}
    let_in = replace(case("machines_4"), machines=0, let_in=(2,))
    result = solved(let_in, {**rows, "bad": d}, Scene(true.truth, places))
    assert result.maps["after"].figures["wrong_pct"] < result.maps["before"].figures["wrong_pct"]
    assert len(result.zeros) == len(without.zeros) + 1
