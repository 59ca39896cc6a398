"""Layers along a line."""

import numpy as np
import pytest

from mapserver.routes.ground import Field, dearest
from protocol.site.geometry import CellWindow


def test_a_plane_is_read_exactly_between_the_centres_of_cells() -> None:
    column, row = np.meshgrid(np.arange(10) + 5, np.arange(8) - 3)
    plane = Field(CellWindow(5, -3, 10, 8), 0.5, 0.1 * (column + 0.5) * 0.5 + 0.2 * (row + 0.5) * 0.5)
    places = np.random.default_rng(0).uniform((3.0, -1.0), (7.0, 2.0), (50, 2))
    assert plane.at(places) == pytest.approx(places @ [0.1, 0.2])


def test_unknown_cells_count_nothing_and_alone_are_unknown() -> None:
    values = np.full((3, 4), np.nan)
    values[1, 1] = 0.03
    field = Field(CellWindow(0, 0, 4, 3), 1.0, values)
    assert field.at(np.array([[1.5, 1.5], [1.9, 1.5]])).tolist() == [0.03, 0.03]
    assert np.isnan(field.at(np.array([[2.4, 1.5], [2.4, 2.4], [-5.0, 1.0], [100.0, 1.0]]))).all()


def test_unknown_ground_is_as_dear_as_the_dearest_tenth() -> None:
    assert dearest(np.append(np.linspace(0.01, 0.11, 101), np.nan)) == pytest.approx(0.1)
    assert np.isnan(dearest(np.full(3, np.nan)))
