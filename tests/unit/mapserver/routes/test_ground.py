"""Layers along a line, its steps, and the speeds that its curves allow."""

import math

import numpy as np
import pytest

from mapserver.routes.ground import CURVE_M, Squares, limits, steps

CORNER = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 30.0]])


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


def test_steps_divide_a_line_evenly() -> None:
    cut = steps(CORNER, 1.0)
    assert len(cut.length_m) == 80
    assert cut.length_m == pytest.approx(np.ones(80))
    assert cut.position_m[0].tolist() == [0.5, 0.0]
    assert cut.position_m[-1].tolist() == [50.0, 29.5]
    assert cut.direction[:50] == pytest.approx(np.tile([1.0, 0.0], (50, 1)))
    assert cut.direction[50:] == pytest.approx(np.tile([0.0, 1.0], (30, 1)))


def test_a_corner_slows_down_around_it_alone() -> None:
    limit = limits(CORNER, steps(CORNER, 1.0).end_m, 0.9)
    assert np.isinf(limit[: 50 - math.ceil(CURVE_M / 2)]).all()
    assert limit[50] == pytest.approx(math.sqrt(0.9 * CURVE_M / (math.pi / 2)))
    assert np.isinf(limit[50 + math.ceil(CURVE_M / 2) + 1 :]).all()


def test_where_it_turns_back_a_machine_stands() -> None:
    back = np.array([[0.0, 0.0], [20.0, 0.0], [5.0, 1.0]])
    cut = steps(back, 1.0)
    limit = limits(back, cut.end_m, 0.9)
    assert np.flatnonzero(limit == 0.0).tolist() == [20]
    assert cut.direction[18] == pytest.approx([1.0, 0.0])
    assert cut.direction[22, 0] < -0.9
    assert np.hypot(*cut.direction.T) == pytest.approx(np.ones(len(cut.direction)))
