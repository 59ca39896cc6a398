"""Equations whose ground is eliminated say what the whole system says."""

import numpy as np
import pytest
import scipy.sparse as sp

from mapserver.fleet.equations import AT_ONCE, Equations, eliminate, equations, sparse, stacked
from protocol.arrays import Floats

N, UNKNOWNS = 300, 20


def system(seed: int, blocks: int, parameters: int = 7) -> Equations:
    """Random equations whose ground is tied together in blocks."""
    draw = np.random.default_rng(seed)
    A = sp.random(N, parameters, 0.4, "csr", random_state=draw)
    first = draw.integers(0, UNKNOWNS // 2, N)
    second = {0: draw.integers(0, UNKNOWNS, N), 1: first, 2: first + UNKNOWNS // 2}[blocks]
    at = first if blocks == 2 else draw.integers(0, UNKNOWNS, N)
    second = at if blocks == 1 else second
    B = sparse(N, UNKNOWNS, (at, draw.normal(size=N)), (second, draw.normal(size=N)))
    return equations(A.tocsr(), B, draw.normal(size=N), draw.uniform(0.5, 2.0, N), blocks)


def whole(eq: Equations, weights: Floats) -> Floats:
    """All unknowns by dense least squares."""
    root = np.sqrt(weights)[:, None]
    return np.linalg.lstsq(root * np.hstack([eq.A.toarray(), eq.B.toarray()]), root[:, 0] * eq.b, rcond=None)[0]


@pytest.mark.parametrize("blocks", [0, 1, 2])
@pytest.mark.parametrize("parameters", [7, AT_ONCE + 5])
def test_elimination_is_the_solution_of_the_whole_system(blocks: int, parameters: int) -> None:
    eq = system(blocks, blocks, parameters)
    weights = eq.weights(np.zeros(parameters), None)
    information = eliminate(eq, weights)
    x = np.linalg.solve(information.matrix, information.vector)
    expected = whole(eq, weights)
    assert x == pytest.approx(expected[:parameters], abs=1e-6)
    assert information.ground(x) == pytest.approx(expected[parameters:], abs=1e-6)


def test_sources_without_common_ground_add_up() -> None:
    one, other = system(1, 1), system(2, 0)
    parts = [eliminate(eq, eq.weights(np.zeros(7), None)) for eq in (one, other)]
    x = np.linalg.solve(sum(p.matrix for p in parts), sum(p.vector for p in parts))
    none = sp.csr_matrix((N, UNKNOWNS))
    both = stacked(
        equations(one.A, sp.hstack([one.B, none]).tocsr(), one.b, one.std, 0),
        equations(other.A, sp.hstack([none, other.B]).tocsr(), other.b, other.std, 0),
    )
    assert x == pytest.approx(whole(both, 1 / both.std**2)[:7], abs=1e-6)


def test_ground_that_nothing_ties_down_is_zero_and_says_nothing() -> None:
    eq = system(3, 1)
    wider = equations(eq.A, sp.hstack([eq.B, sp.csr_matrix((N, 5))]).tocsr(), eq.b, eq.std, 1)
    information, same = (eliminate(each, 1 / each.std**2) for each in (wider, eq))
    assert information.matrix == pytest.approx(same.matrix)
    assert information.ground(np.ones(7))[-5:] == pytest.approx(0.0)


def test_far_equations_count_little_and_heavy_ones_hardly() -> None:
    b = np.array([0.5, 3.0, 30.0, 3.0, 30.0])
    eq = equations(sp.csr_matrix((5, 1)), None, b, np.ones(5))
    eq.heavy[3:] = True
    assert eq.weights(np.zeros(1), np.zeros(0)) == pytest.approx([1.0, 0.5, 0.05, 0.1, 1 / 901])


def test_equations_on_known_ground_leave_other_ground_away() -> None:
    eq = system(4, 1)
    y = np.arange(UNKNOWNS, dtype=np.float64)
    y[3] = np.nan
    on = eq.on(y)
    elsewhere = eq.B[:, 3].toarray()[:, 0] != 0
    assert len(on.b) == N - elsewhere.sum()
    assert on.b == pytest.approx((eq.b - eq.B @ np.nan_to_num(y))[~elsewhere])
    assert on.B.shape[1] == 0
