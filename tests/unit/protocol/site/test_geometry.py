import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.site.geometry import Bounds, CellWindow, GridGeometry

cells = st.sampled_from([0.05, 0.1, 0.2, 0.25, 1 / 3, 0.5, 1.0, 3.0, 100.0])
index, size = st.integers(-10_000, 10_000), st.integers(1, 500)


@given(cells, index, index, size, size)
def test_window_of_its_own_bounds_is_itself(cell_m, column, row, columns, rows):
    geometry, window = GridGeometry(cell_m), CellWindow(column, row, columns, rows)
    assert geometry.window(geometry.bounds(window)) == window


@given(cells, *[st.floats(-20_000, 20_000)] * 2, *[st.floats(1e-3, 500)] * 2)
def test_window_holds_its_bounds(cell_m, west, south, width, height):
    geometry, bounds = GridGeometry(cell_m), Bounds(west, south, west + width, south + height)
    held = geometry.bounds(geometry.window(bounds))
    slack = 1e-6 * cell_m
    assert held.west_m <= bounds.west_m + slack
    assert held.south_m <= bounds.south_m + slack
    assert held.east_m >= bounds.east_m - slack
    assert held.north_m >= bounds.north_m - slack


def test_negative_positions_are_in_negative_cells():
    geometry = GridGeometry(1.0)
    assert geometry.cell_of(np.array([-1.0, -0.5, -1e-9, 0.0, 0.999, 1.0])).tolist() == [-1, -1, -1, 0, 0, 1]
    assert geometry.window(Bounds(-0.5, -1.0, 0.5, 1.0)) == CellWindow(-1, -1, 2, 2)


@given(cells, st.integers(-10_000, 10_000))
def test_centre_of_a_cell_is_in_the_cell(cell_m, cell):
    geometry = GridGeometry(cell_m)
    assert geometry.cell_of(geometry.centres(cell, 3)).tolist() == [cell, cell + 1, cell + 2]


def test_sliver_is_one_cell():
    assert GridGeometry(1.0).window(Bounds(3.0, 3.0, 3.0 + 1e-12, 3.5)) == CellWindow(3, 3, 1, 1)


@pytest.mark.parametrize("values", [(0, 0, 0, 1), (1, 0, 0, 1), (0, 2, 1, 1), (math.nan, 0, 1, 1), (0, 0, math.inf, 1)])
def test_bounds_that_hold_nothing_are_refused(values):
    with pytest.raises(ValueError, match="bounds"):
        Bounds(*values)
