"""Layers along a line."""

import numpy as np
import pytest

from mapserver.routes.ground import Squares


def test_a_plane_is_read_exactly_between_the_centres_of_cells_and_over_edges_of_squares() -> None:
    squares = {}
    for x in range(-2, 2):
        for y in range(-1, 1):
            column, row = np.meshgrid(np.arange(8) + 8 * x, np.arange(8) + 8 * y)
            squares[x, y] = {"a": 0.1 * (column + 0.5) * 0.5 + 0.2 * (row + 0.5) * 0.5, "b": np.full((8, 8), 3.0)}
    places = np.random.default_rng(0).uniform((-7.0, -3.5), (7.0, 3.5), (200, 2))
    along = Squares.stacked(0.5, 8, squares).at(places)
    assert along["a"] == pytest.approx(places @ [0.1, 0.2])
    assert along["b"] == pytest.approx(np.full(200, 3.0))


def test_unknown_cells_count_nothing_and_alone_are_unknown() -> None:
    values = np.full((4, 4), np.nan)
    values[1, 1] = 0.03
    field = Squares.stacked(1.0, 4, {(0, 0): {"a": values}})
    assert field.at(np.array([[1.5, 1.5], [1.9, 1.5]]))["a"].tolist() == [0.03, 0.03]
    assert np.isnan(field.at(np.array([[2.4, 1.5], [2.4, 2.4], [-5.0, 1.0], [100.0, 1.0]]))["a"]).all()
