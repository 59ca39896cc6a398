"""The algorithm against its formulas: constant mass, jumping ground."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.balance import BalanceStep
from agents.estimation.resistance_rls import MultipleForgetting, RecursiveGrade, RecursiveResistance
from protocol.arrays import Floats
from tests.unit.agents.drives import START_NS
from tests.unit.agents.ground import STEP_S, feed, level_steps


def by_the_paper(
    ys: Floats, hs: Floats, variance: Floats, forget: Floats, dt_s: float
) -> tuple[list[list[float]], list[list[float]]]:
    """The docstring's formulas for two parameters: parameters and variances by step."""
    (p1, p2), (l1, l2) = variance, (f**dt_s for f in forget)
    theta1 = theta2 = 0.0
    thetas, variances = [], []
    for y, (h1, h2) in zip(ys, hs, strict=True):
        denominator = 1 + p1 * h1 * h1 / l1 + p2 * h2 * h2 / l2
        off = y - h1 * theta1 - h2 * theta2
        theta1 += p1 * h1 / l1 / denominator * off
        theta2 += p2 * h2 / l2 / denominator * off
        alone1 = p1 * h1 / l1 / (1 + p1 * h1 * h1 / l1)
        alone2 = p2 * h2 / l2 / (1 + p2 * h2 * h2 / l2)
        p1, p2 = (1 - alone1 * h1) * p1 / l1, (1 - alone2 * h2) * p2 / l2
        thetas.append([theta1, theta2])
        variances.append([p1, p2])
    return thetas, variances


def test_it_is_the_algorithm_of_the_paper() -> None:
    seed, n = 1, 200
    rng = np.random.default_rng(seed)
    hs = rng.uniform(-1, 1, (n, 2))
    ys = hs @ [0.3, 0.05] + 0.01 * rng.standard_normal(n)
    variance, forget = np.array([0.5, 2.0]), np.array([0.99, 0.5])
    squares = MultipleForgetting(np.zeros(2), variance, forget, np.full(2, 1e9))
    thetas, variances = by_the_paper(ys, hs, variance, forget, STEP_S)
    for y, h, theta, p in zip(ys, hs, thetas, variances, strict=True):
        squares.update(STEP_S, float(y), h)
        assert squares.parameters == pytest.approx(theta, rel=1e-9), f"{seed=}"
        assert squares.variance == pytest.approx(p, rel=1e-9), f"{seed=}"


def test_grade_is_the_slope_of_the_mean_sine() -> None:
    seed, slope_rad, grade = 6, -0.3, RecursiveGrade()
    rng = np.random.default_rng(seed)
    estimates = [grade.update(STEP_S, math.sin(slope_rad) + 0.02 * rng.standard_normal()) for _ in range(400)]
    assert np.mean(estimates[200:]) == pytest.approx(slope_rad, abs=3e-3), f"{seed=}"
    assert np.std(estimates[200:]) < 0.02
    later = [grade.update(STEP_S, 0.0) for _ in range(round(2 / STEP_S))]
    assert later[-1] == pytest.approx(0.2**2 * slope_rad, abs=0.01)


def test_recalibrated_goes_on_from_what_it_would_have_been() -> None:
    regressor = -1.0

    def steps(raw: float) -> list[BalanceStep]:
        return [replace(step, regressor=regressor, raw=regressor * raw) for step in level_steps(np.full(400, raw))]

    estimator = RecursiveResistance()
    feed(estimator, steps(0.04))
    estimator.recalibrate(0.005, 0.1)
    c_rr, _ = estimator.at(START_NS + 399 * round(STEP_S * 1e9))
    assert c_rr == pytest.approx(0.04 - regressor * (0.005 + 0.1 * 0.04), abs=1e-4)


def test_a_load_that_changes_at_a_stop_is_found_again_sooner() -> None:
    share = 0.05 + 0.2 * np.sin(0.3 * np.arange(3000))
    estimates = []
    for loads in (True, False):
        rls = RecursiveResistance(estimates_mass=True)
        feed(rls, level_steps(0.05 + 0 * share, share=share))
        known = rls._squares.variance[0]
        rls.stand(changes_load=loads)
        assert rls._squares.variance[0] == (min(10 * known, 1e-2) if loads else known)
        feed(rls, level_steps(0.05 + 0.15 * share[:400], share=share[:400]))
        estimates.append(abs(rls._squares.parameters[0] - 0.15))
    assert estimates[0] < estimates[1] - 1e-3


def test_only_the_recent_past_has_an_estimate() -> None:
    rls = RecursiveResistance()
    assert rls.at(START_NS) is None
    feed(rls, level_steps(np.full(20, 0.05)))
    end = START_NS + 19 * 50_000_000
    assert rls.at(end + 490_000_000)
    assert rls.at(end + 510_000_000) is None


def test_variance_stays_below_its_bound_without_excitation() -> None:
    squares = MultipleForgetting(np.zeros(2), np.ones(2), np.full(2, 0.1), np.array([3.0, 5.0]))
    for _ in range(200):
        squares.update(STEP_S, 0.0, np.zeros(2))
    assert squares.variance.tolist() == [3.0, 5.0]
