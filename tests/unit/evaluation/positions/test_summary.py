"""Means, intervals and paired ratios on made-up scores."""

import math

import numpy as np
import pytest

from evaluation.positions.configurations import Configuration
from evaluation.positions.replay import Score
from evaluation.positions.summary import paired_ratio, ratios, summarise

ROW = Configuration("ukf", 1, 1, "default")


def score(net_m: float, max_m: float = 3.0, us: float = 100.0) -> Score:
    return Score(0.6 * net_m, 0.8 * net_m, net_m, max_m, 2.0, 1.0, 3.0, 0.95, 0.98, us)


def test_row_has_means_over_seeds_and_stands_beside_the_paper():
    row = summarise(ROW, [score(1.0, 4.0), score(2.0, 7.0, 300.0)])
    assert (row.filter, row.gps, row.imu, row.profile) == ("ukf", 1, 1, "default")
    assert (row.rmse_x_m, row.rmse_y_m, row.net_m) == (0.9, 1.2, 1.5)
    assert (row.max_m, row.us_per_second) == (7.0, 200)
    assert row.paper_net_m == 2.3234
    assert row.difference_m == pytest.approx(1.5 - 2.3234)
    assert row.net_by_seed_m == [1.0, 2.0]
    assert row.nees_95 == pytest.approx([2 - 0.707, 2 + 0.707])
    assert row.ci95_m == pytest.approx(12.7062 * math.sqrt(0.5) / math.sqrt(2), abs=1e-3)


def test_a_single_seed_has_no_interval_and_a_row_of_ours_no_figure_of_the_paper():
    row = summarise(Configuration("ukf", 3, 1, "default"), [score(1.0)])
    assert row.ci95_m is None
    assert row.paper_net_m is row.difference_m is None


def test_pairing_takes_out_what_recordings_have_in_common():
    hard = np.random.default_rng(6).uniform(1, 4, 12)
    ratio, half = paired_ratio(0.7 * hard, hard)
    assert ratio == pytest.approx(0.7)
    assert half == pytest.approx(0.0, abs=1e-12)


def test_ratios_are_of_profiles_and_of_filters_that_were_both_run():
    rows = {(f, p): Configuration(f, 1, 1, p) for f, p in (("ukf", "paper"), ("ukf", "default"), ("ekf", "default"))}
    net = {("ukf", "paper"): 2.0, ("ukf", "default"): 1.0, ("ekf", "default"): 1.1}
    pairs = ratios({row: [score(net[key]), score(2 * net[key])] for key, row in rows.items()})
    assert [(r.ratio, r.filter, r.profile, r.net) for r in pairs] == [
        ("default/paper", "ukf", "default", 0.5),
        ("ekf/ukf", "ekf", "default", 1.1),
    ]
    assert ratios({ROW: [score(1.0)]}) == []
