import math
from dataclasses import dataclass

import numpy as np
import pytest

from evaluation.campaign.figures import half_width, root_mean_square, rounded


def test_interval_of_a_mean_holds_it_19_times_in_20():
    rng = np.random.default_rng(5)
    samples = rng.normal(3.0, 1.0, (1000, 6))
    held = [abs(s.mean() - 3.0) <= (half_width(s) or 0) for s in samples]
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)
    assert half_width(np.ones(1)) is None


def test_root_mean_square_of_nothing_is_not_known():
    assert root_mean_square(np.array([3.0, -4.0])) == pytest.approx(math.sqrt(12.5))
    assert math.isnan(root_mean_square(np.empty(0)))


def test_rounding_reaches_every_float_and_leaves_the_rest():
    @dataclass(frozen=True)
    class Part:
        share: float

    @dataclass(frozen=True)
    class Row:
        name: str
        count: int
        met: bool
        net_m: float
        max_m: float | None
        by_seed: list[float]
        parts: list[Part]
        reasons: dict[str, int]

    row = Row("a", 12345, True, 1.23456, None, [0.11111, math.inf], [Part(2 / 3)], {"gap": 2})
    expected = Row("a", 12345, True, 1.23, None, [0.1111, math.inf], [Part(0.67)], {"gap": 2})
    assert rounded(row, 2, by_seed=4) == expected
