"""Prices of ground where nobody was, and slopes between known ground."""

import numpy as np
import pytest

from mapserver.routes.ground import Squares
from mapserver.routes.prices import LOOSE, NEEDS, RESISTANCE, Prices, bare

EDGE = 32
HERE = {(0, 0)}


def squares(made: dict[tuple[int, int], dict[str, object]], std: float = 0.001) -> Squares:
    """Of resistance, grade (east) and where machines were; NaN where nothing is said."""
    out = {}
    for place, values in made.items():
        layers = {name: np.full((EDGE, EDGE), np.nan) for name in NEEDS}
        layers["resistance_filled"][:] = values.get("resistance", np.nan)
        layers["grade_east_filled"][:] = values.get("grade", 0.0)
        layers["grade_north_filled"][:] = 0.0
        layers["resistance_filled_std"][:] = values.get("std", std)
        layers["visits"][:] = np.where(values.get("driven", True), 3.0, np.nan)
        out[place] = layers
    return Squares.stacked(0.5, EDGE, out)


def half(known: float, beyond: float = np.nan) -> np.ndarray:
    return np.where(np.arange(EDGE) < EDGE // 2, known, beyond) + np.zeros((EDGE, 1))


def test_unknown_ground_is_as_dear_as_the_dearest_tenth_around_uphill() -> None:
    gravel, slope = half(0.03), half(0.04)
    one = squares({(0, 0): {"resistance": gravel, "grade": slope, "driven": np.isfinite(gravel)}})
    price = Prices(one).squares(HERE).layers[RESISTANCE][0]
    assert np.isnan(price[:, : EDGE // 2]).all()
    assert price[:, EDGE // 2 :] == pytest.approx(0.07, rel=0.02)
    dear = squares({(0, 0): {"resistance": gravel, "driven": np.isfinite(gravel)}, (0, 1): {"resistance": 0.12}})
    assert Prices(dear).squares(HERE).layers[RESISTANCE][0][0, -1] == pytest.approx(0.12, rel=0.02)
    assert Prices(dear, 0.05).squares(HERE).layers[RESISTANCE][0][0, -1] == pytest.approx(0.05)


def test_what_is_filled_in_costs_more_the_less_sure_it_is() -> None:
    road = half(0.03, 0.03)
    driven = np.arange(EDGE) < EDGE // 2
    std = np.where(driven, 0.001, 0.03 * np.linspace(0.0, 1.3, EDGE)) + np.zeros((EDGE, 1))
    beside = {"resistance": road, "std": std, "driven": driven & np.ones((EDGE, 1), bool)}
    one = squares({(0, 0): beside, (1, 0): {"resistance": 0.13}})
    price = Prices(one).squares(HERE).layers[RESISTANCE][0][5, EDGE // 2 :]
    assert (np.diff(price) > 0).all()
    assert price[-1] == pytest.approx(0.13, rel=0.02)
    assert 0.03 < price[0] < 0.09


def test_far_from_everything_ground_is_as_loose_as_sand_unless_somebody_says_what_it_is() -> None:
    far = squares({(3, 0): {"resistance": 0.03}})
    assert (Prices(far).squares(HERE).layers[RESISTANCE] == LOOSE).all()
    assert (Prices(far, 0.04).squares(HERE).layers[RESISTANCE] == 0.04).all()


def test_squares_are_bare_where_any_cell_was_never_driven() -> None:
    driven = np.ones((EDGE, EDGE), bool)
    driven[3, 4] = False
    some = squares({(0, 0): {"resistance": 0.03}, (1, 0): {"resistance": 0.03, "driven": driven}})
    assert bare(some, {(0, 0), (1, 0), (5, 5)}) == {(1, 0), (5, 5)}
