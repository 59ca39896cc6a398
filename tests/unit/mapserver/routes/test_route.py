"""Routes over ground of known cost, and prices of unvisited ground."""

import math

import numpy as np
import pytest

from mapserver.routes.ground import Squares
from mapserver.routes.prices import LOOSE, NEEDS, RESISTANCE, Prices, bare
from mapserver.routes.route import LAYERS, STEP_M, route
from protocol.arrays import Floats
from protocol.errors import QueryError
from protocol.queries.routing import RouteMachine
from protocol.units import GRAVITY_MPS2

SIZE = 220
SLOW = RouteMachine(mass_kg=20_000.0, speed_mps=2.0)  # slow enough to roll out without brakes
WEIGHT_N = 20_000 * GRAVITY_MPS2
ROLLING = (False, False)


def fields(resistance: Floats | float, east: float = 0.0, north: float = 0.0, std: float = 0.003) -> Squares:
    even = np.zeros((SIZE, SIZE))
    values = {
        "resistance_filled": even + resistance,
        "grade_east_filled": even + east,
        "grade_north_filled": even + north,
    }
    values |= {
        "resistance_filled_std": even + std,
        "grade_filled_std": even + std,
        "visits": even + 4,
        "confidence": even + 0.9,
    }
    assert set(values) == set(LAYERS)
    return Squares.stacked(1.0, SIZE, {(0, 0): values})


def line(*corners: tuple[float, float]) -> Floats:
    return np.array(corners, float)


def test_the_interval_holds_the_cost_and_grows_with_what_is_not_sure() -> None:
    ahead = line((10, 10), (170, 130))
    _, sure = route(ahead, fields(0.03, std=0.001), SLOW)
    _, unsure = route(ahead, fields(0.03, std=0.01), SLOW)
    for totals in (sure, unsure):
        assert totals.energy_low_j < totals.energy_j < totals.energy_high_j
        assert totals.time_low_s <= totals.time_s <= totals.time_high_s
    assert unsure.energy_high_j - unsure.energy_low_j > 2 * (sure.energy_high_j - sure.energy_low_j)


def test_a_slope_that_is_wrong_is_a_resistance_that_is_wrong_the_other_way() -> None:
    """Where both were measured; neighbours' slopes are unrelated to neighbours' resistance."""
    ahead, width = line((10, 10), (170, 130)), {}
    for name, visits, slope_std in (("sure", 4.0, 0.0), ("measured", 4.0, 0.02), ("filled", np.nan, 0.02)):
        ground = fields(0.03)
        ground.layers["visits"][:] = visits
        ground.layers["grade_filled_std"][:] = slope_std
        totals = route(ahead, ground, SLOW)[1]
        width[name] = totals.energy_high_j - totals.energy_low_j
    assert width["sure"] == width["measured"]
    assert width["filled"] > 1.5 * width["measured"]


def test_no_line_is_so_long_that_errors_of_a_map_vanish() -> None:
    """Errors of scale and of drives are common to all of it."""
    _, totals = route(line((1, 1), (219, 219), (1, 219), (219, 1)), fields(0.1, std=1e-6), SLOW, stops=ROLLING)
    half = (totals.energy_high_j - totals.energy_low_j) / 2 / totals.energy_j
    assert half == pytest.approx(1.645 * math.hypot(0.03, 0.02), rel=0.1)


def test_what_was_driven_on_and_not_measured_lies_between_what_was() -> None:
    """Uncertain by half its ends' difference; its slope is known."""
    soils = np.where(np.arange(SIZE) < 100, 0.01, 0.09) + np.zeros((SIZE, 1))
    soils[:, 80:121] = np.nan
    layers = fields(soils, east=0.01)
    steps, totals = route(line((10, 50), (190, 50)), layers, SLOW, stops=ROLLING, step_m=10)
    assert (totals.unknown, totals.unmeasured) == (0.0, pytest.approx(41 / 180, abs=0.01))
    assert (np.diff(steps.resistance) >= -1e-9).all()
    assert steps.resistance[8:10].mean() == pytest.approx(0.03, rel=0.1)  # in the middle, of the logarithm
    assert totals.lift_m == pytest.approx(1.8)
    even = fields(np.where(np.isnan(soils), np.nan, 0.02), east=0.01)
    _, sure = route(line((10, 50), (190, 50)), even, SLOW, stops=ROLLING)
    assert sure.energy_j == pytest.approx(WEIGHT_N * (0.02 + 0.01) * 180, rel=1e-3)
    assert (totals.energy_high_j - totals.energy_low_j) > 3 * (sure.energy_high_j - sure.energy_low_j)
    beyond = fields(np.where(np.arange(SIZE) < 100, 0.01, np.nan) + np.zeros((SIZE, 1)))
    last, _ = route(line((10, 50), (190, 50)), beyond, SLOW, stops=ROLLING)
    assert last.resistance[-1] == pytest.approx(0.01)


def test_a_machine_too_weak_for_a_slope_is_told_where() -> None:
    layers = fields(0.03)
    layers.layers["grade_east_filled"][0, :, 100:140] = 0.9
    weak = RouteMachine(mass_kg=40_000.0, power_w=60_000.0)
    with pytest.raises(QueryError, match=r"cannot climb at (9\d|1\d\d), 50 m: .* % of its weight; more `power`"):
        route(line((10, 50), (200, 50)), layers, weak)


def test_a_short_line_is_one_step() -> None:
    steps, totals = route(line((10, 50), (10.4, 50)), fields(0.03), SLOW)
    assert steps.length_m == pytest.approx([0.4])
    assert totals.length_m == pytest.approx(0.4)
    assert STEP_M > 0.4


EDGE = 32
HERE = {(0, 0)}


def squares(made: dict[tuple[int, int], dict[str, object]], std: float = 0.001) -> Squares:
    """Resistance, grade (east) and visited squares; NaN: unknown."""
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
