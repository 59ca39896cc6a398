"""Merges of samples with a known map."""

import numpy as np
import pytest

from lab.maps import methods
from lab.maps.methods import Hits, hits_of, kalman, last_write, mean, median, soft_votes
from lab.maps.samples import Delivery
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow

NAN = np.nan
WINDOW = CellWindow(0, 0, 20, 18)


def hits(cell, value, variance=1.0, cells: int = 3) -> Hits:
    value = np.array(value, float)
    return Hits(np.array(cell, np.int64), value, np.broadcast_to(variance, value.shape), cells)


def samples(stamp, x, y, c_rr):
    rows = empty(len(stamp))
    for name, values in {"stamp_ns": stamp, "x_m": x, "y_m": y, "c_rr": c_rr}.items():
        rows[name] = values
    rows["distance_m"], rows["c_rr_var"], rows["grade_e"], rows["grade_n"] = 0.6, 4e-6, 0.05, -0.1
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.01
    return rows


@pytest.mark.parametrize(
    ("method", "cell", "value"),
    [
        (last_write, [0, 2, 0], [1, 5, 3]),
        (mean, [0, 2, 0], [2, 5, 4]),
        (median, [0, 0, 0, 2, 2, 0, 0], [1, 2, 90, 4, 6, 3, 80]),  # robust to outliers
    ],
)
def test_a_cell_has_the_last_value_or_the_mean_or_the_median(method, cell, value):
    np.testing.assert_array_equal(method(hits(cell, value)), [3, NAN, 5])


def test_a_kalman_filter_weighs_by_variance():
    assert kalman(hits([0, 0], [0.0, 1.0], [1.0, 3.0]))[0] == pytest.approx(0.25)


def test_a_kalman_filter_rejects_an_outlier_and_gives_in_to_many():
    assert kalman(hits([0] * 5, [0, 0, 0, 9, 0]))[0] == pytest.approx(0.0)
    at_the_gate = methods.GATE_SIGMA * np.sqrt(2)
    assert kalman(hits([0, 0], [0, at_the_gate * 0.999]))[0] > 1
    assert kalman(hits([0, 0], [0, at_the_gate * 1.001]))[0] == 0
    assert kalman(hits([0] * 30, [0] * 3 + [9] * 27))[0] == pytest.approx(9.0, abs=0.5)


def test_samples_fall_into_the_cell_of_their_stated_position():
    rows = samples([1, 2, 3, 4], [0.99, 1.0, -0.1, 20.0], [0.5, 2.5, 0.5, 0.5], [0.02, NAN, 0.02, 0.02])
    assert hits_of(rows, "resistance", WINDOW).cell.tolist() == [0]
    result = hits_of(rows, "grade_north", WINDOW)
    assert result.cell.tolist() == [0, 41]
    assert result.value == pytest.approx([-0.1, -0.1])
    assert hits_of(rows, "grade_east", CellWindow(1, 2, 3, 3)).cell.tolist() == [0]


def deliveries():
    """Two consistent machines on the same ten cells across a block edge."""
    stamp = np.arange(1, 51) * 10**9
    x, y = np.tile(np.arange(11, 21) - 0.5, 5), np.full(50, 16.5)
    return [Delivery(name, samples(stamp, x, y, 0.02), int(stamp[-1])) for name in ("a", "b")]


def test_the_server_makes_its_own_map():
    result, distrusted = soft_votes(deliveries(), WINDOW)
    assert distrusted == ()
    assert set(result) == {"resistance", "grade_east", "grade_north", "confidence"}
    driven = np.s_[16, 10:20]
    assert result["resistance"].shape == (18, 20)
    for name, value in (("resistance", 0.02), ("grade_east", 0.05), ("grade_north", -0.1)):
        np.testing.assert_allclose(result[name][driven], value, atol=2e-4 if name == "resistance" else 1e-3)
    assert (result["confidence"][driven] > 0.9).all()
    assert np.isnan(result["resistance"][10]).all()
