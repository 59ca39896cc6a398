"""Scores of class forecasts and stated deviations with known answers."""

import math

import numpy as np
import pytest

from lab.maps.methods import Hits
from lab.maps.uncertainty import Believed, by_frequency, by_mean, coverage_pct, pooled
from protocol.site.ground_classes import UNKNOWN


def hits(cell, value, variance=1e-6, cells: int = 2) -> Hits:
    value = np.array(value, float)
    return Hits(np.array(cell, np.int64), value, np.broadcast_to(variance, value.shape), cells)


def test_who_is_right_as_often_as_said_has_no_error():
    draw = np.random.default_rng(4)
    said = draw.uniform(0.2, 1.0, 200_000)
    honest = Believed(said, draw.random(said.size) < said)
    assert honest.calibration_error < 0.005
    vain = Believed(np.sqrt(said), honest.right)
    assert vain.calibration_error == pytest.approx(float((np.sqrt(said) - said).mean()), abs=0.005)
    assert honest.brier < vain.brier
    assert honest.log_score < vain.log_score


def test_scores_of_a_single_cell():
    sure, wrong = Believed(np.array([0.8]), np.array([True])), Believed(np.array([1.0]), np.array([False]))
    assert (sure.brier, sure.log_score) == (pytest.approx(0.04), pytest.approx(-math.log(0.8)))
    assert (wrong.brier, wrong.log_score) == (1.0, pytest.approx(-math.log(0.001)))  # finite
    both = pooled([sure, wrong])
    assert both.brier == pytest.approx(0.52)
    assert both.calibration_error == pytest.approx((0.2 + 1.0) / 2)


def test_the_last_value_is_as_likely_as_it_is_frequent():
    forecast = by_frequency(hits([0, 0, 0, 0], [0.04, 0.04, 0.06, 0.041]))
    assert forecast.kind.tolist() == [2, UNKNOWN]
    assert forecast.confidence[0] == 0.75


def test_a_mean_is_as_likely_as_its_values_agree():
    agree, differ = by_mean(hits([0, 0], [0.04, 0.04])), by_mean(hits([0, 0], [0.02, 0.06]))
    assert agree.kind.tolist() == differ.kind.tolist() == [2, UNKNOWN]
    assert agree.confidence[0] > 0.999
    assert differ.confidence[0] == pytest.approx(0.383, abs=0.01)  # half a deviation of 0.02 to either side
    assert by_mean(hits([0], [0.04], 0.02**2)).confidence[0] == pytest.approx(0.383, abs=0.01)


def test_coverage_is_the_share_within_the_interval_of_what_is_known():
    draw = np.random.default_rng(5)
    error = draw.normal(0, 2.0, 100_000)
    assert coverage_pct(error, np.full(error.shape, 2.0)) == pytest.approx(95.0, abs=0.3)
    assert coverage_pct(np.array([0.0, 9.0, np.nan, 0.0]), np.array([1.0, 1.0, 1.0, np.nan])) == 50.0
    assert math.isnan(coverage_pct(np.array([np.nan]), np.array([1.0])))
