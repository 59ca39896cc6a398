"""The paper's tensor: places and values."""

import numpy as np

from lab.paper.tensor import tensor
from sim.truth import TruthMap

ROWS, COLUMNS = 2, 3
LAYERS = {
    "resistance": np.array([[0.04, np.nan, 0.06], [0.02, 0.25, 0.008]], np.float32),
    "grade_east": np.array([[0.3, np.nan, 0.0], [0.0, 0.0, 0.0]], np.float32),
    "grade_north": np.array([[0.4, np.nan, 0.0], [0.0, 0.0, -0.2]], np.float32),
}
TRUTH = TruthMap(10.0, 20.0, *LAYERS.values())


def test_a_cell_is_its_place_and_its_value():
    made = tensor(LAYERS, TRUTH)
    assert made.shape == (2, COLUMNS, ROWS, 3)
    np.testing.assert_allclose(made[0, 2, 0], [12.5, 20.5, 0.06])
    np.testing.assert_allclose(made[0, 1, 1], [11.5, 21.5, 0.25])
    np.testing.assert_allclose(made[1, 0, 0], [10.5, 20.5, 0.5])  # steepness, unsigned
    np.testing.assert_allclose(made[1, 2, 1], [12.5, 21.5, 0.2])


def test_a_cell_that_was_never_passed_is_nan_and_has_a_place():
    made = tensor(LAYERS, TRUTH)
    assert np.isnan(made[..., 2]).sum() == 2
    np.testing.assert_allclose(made[0, 1, 0, :2], [11.5, 20.5])
    assert np.isfinite(made[..., :2]).all()
