"""Consistency of Gaussian errors with known answers."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from sitegrid.logs import consistency
from sitegrid.logs.consistency import ConsistencySummary, independent_values, normalised_square, summarise

COVARIANCE = np.array([[4.0, 1.2], [1.2, 1.0]])


def drawn(n: int, scale: float = 1.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Errors of COVARIANCE times scale squared, with stated COVARIANCE."""
    errors = np.random.default_rng(seed).multivariate_normal([0, 0], COVARIANCE * scale**2, n)
    return errors, np.broadcast_to(COVARIANCE, (n, 2, 2))


def slow(n: int, correlation: float, seed: int = 2) -> np.ndarray:
    draws = np.random.default_rng(seed).standard_normal(n)
    draws[1:] *= math.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], draws)


def is_consistent(summary: ConsistencySummary) -> bool:
    return summary.low <= summary.mean <= summary.high


def test_normalised_square_is_the_squared_mahalanobis_distance():
    covariances = np.array([np.diag([4.0, 9.0]), [[2.0, 1.0], [1.0, 2.0]]])
    assert normalised_square(np.array([[2.0, 3.0], [1.0, 1.0]]), covariances) == pytest.approx([2.0, 2 / 3])
    assert normalised_square(np.array([[3.0]]), np.array([[[4.0]]])) == pytest.approx([2.25])  # one component


@pytest.mark.parametrize(("scale", "mean", "coverage"), [(1.2, 2.88, 0.875), (0.8, 1.28, 0.9907), (2.0, 8.0, 0.527)])
def test_a_wrong_sigma_shows(scale: float, mean: float, coverage: float):
    """Coverage of a 2-D ellipse is 1 - exp(-limit / (2 scale^2))."""
    summary = summarise(normalised_square(*drawn(4000, scale)), dof=2)
    assert not is_consistent(summary)
    assert summary.mean == pytest.approx(mean, rel=0.06)
    assert summary.coverage == pytest.approx(coverage, abs=0.02)


def test_limits_are_those_of_the_tables():
    assert consistency.ellipse_limit(2) == pytest.approx(5.991, abs=1e-3)
    assert consistency.ellipse_limit(3) == pytest.approx(7.815, abs=1e-3)
    low, high = consistency.mean_interval(2, 50)  # chi-square, 100 degrees of freedom: 74.222 to 129.561
    assert (low, high) == (pytest.approx(74.222 / 50, abs=1e-3), pytest.approx(129.561 / 50, abs=1e-3))


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9, 0.98])
def test_slow_errors_are_worth_fewer_values(correlation: float):
    n = 40_000
    expected = n * (1 - correlation) / (1 + correlation)
    assert independent_values(slow(n, correlation)) == pytest.approx(expected, rel=0.25)


def test_slow_errors_of_the_right_size_are_consistent_although_their_mean_wanders():
    errors = np.stack([slow(3000, 0.995, seed) for seed in (3, 4)], axis=1)
    squares = normalised_square(errors, np.broadcast_to(np.eye(2), (3000, 2, 2)))
    summary, narrow = summarise(squares, dof=2), summarise(squares, dof=2, independent=3000)
    assert is_consistent(summary)
    assert summary.high - summary.low > 3 * (narrow.high - narrow.low)
