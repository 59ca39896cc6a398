"""Equations with eliminated ground equal the whole system."""

import numpy as np
import pytest
import scipy.sparse as sp

from mapserver.calibration.equations import AT_ONCE, Equations, eliminate, equations, sparse

N, UNKNOWNS = 300, 20


def system(seed: int, blocks: int, parameters: int = 7) -> Equations:
    """Random equations with block-coupled ground."""
    draw = np.random.default_rng(seed)
    A = sp.random(N, parameters, 0.4, "csr", random_state=draw)
    first = draw.integers(0, UNKNOWNS // 2, N)
    second = {0: draw.integers(0, UNKNOWNS, N), 1: first, 2: first + UNKNOWNS // 2}[blocks]
    at = first if blocks == 2 else draw.integers(0, UNKNOWNS, N)
    second = at if blocks == 1 else second
    B = sparse(N, UNKNOWNS, (at, draw.normal(size=N)), (second, draw.normal(size=N)))
    return equations(A.tocsr(), B, draw.normal(size=N), draw.uniform(0.5, 2.0, N), blocks)


@pytest.mark.parametrize("blocks", [0, 1, 2])
@pytest.mark.parametrize("parameters", [7, AT_ONCE + 5])
def test_elimination_is_the_solution_of_the_whole_system(blocks: int, parameters: int) -> None:
    eq = system(blocks, blocks, parameters)
    weights = eq.weights(np.zeros(parameters), None)
    information = eliminate(eq, weights)
    x = np.linalg.solve(information.matrix, information.vector)
    root = np.sqrt(weights)[:, None]
    expected = np.linalg.lstsq(root * np.hstack([eq.A.toarray(), eq.B.toarray()]), root[:, 0] * eq.b, rcond=None)[0]
    assert x == pytest.approx(expected[:parameters], abs=1e-6)
    assert information.ground(x) == pytest.approx(expected[parameters:], abs=1e-6)


def test_far_equations_count_little_and_heavy_ones_hardly() -> None:
    b = np.array([0.5, 3.0, 30.0, 3.0, 30.0])
    eq = equations(sp.csr_matrix((5, 1)), None, b, np.ones(5))
    eq.heavy[3:] = True
    assert eq.weights(np.zeros(1), np.zeros(0)) == pytest.approx([1.0, 0.5, 0.05, 0.1, 1 / 901])
