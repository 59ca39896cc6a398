"""Figures of reports: root mean squares and rounding."""

import math

import numpy as np
import pytest

from sitegrid.proof.figures import root_mean_square, rounded


def test_root_mean_square_of_nothing_is_not_known():
    assert root_mean_square(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(root_mean_square(np.empty(0)))


def test_rounding_reaches_every_float_and_leaves_the_rest():
    row = {"name": "a", "count": 12345, "met": True, "net_m": 1.23456, "max_m": None, "reasons": {"gap": 2}}
    inner = {"by_seed": [0.11111, math.inf], "parts": [{"share": 2 / 3}]}
    expected = {"net_m": 1.23, "by_seed": [0.1111, math.inf], "parts": [{"share": 0.67}]}
    assert rounded({**row, **inner}, 2, by_seed=4) == {**row, **expected}
    assert rounded(row, 2)["met"] is True
