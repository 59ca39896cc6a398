"""Drives with known answers: energy of resistance, height, speed; speed limits of power, curves, brakes."""

import math

import numpy as np
import pytest

from mapserver.routes.drive import CREEP_MPS, LATE_S, Drive, drive, smoothed
from mapserver.routes.ground import CURVE_M, Squares, limits, steps
from protocol.arrays import Floats
from protocol.queries.routing import RouteMachine
from protocol.units import GRAVITY_MPS2

MACHINE = RouteMachine(mass_kg=20_000.0, speed_mps=8.0, power_w=200_000.0)
N = 1000


def rolling(
    resistance: float | Floats, slope: float | Floats, machine: RouteMachine = MACHINE, ends: float = 2.0
) -> Drive:
    """N steps of 1 m with equal speed at both ends."""
    limit = np.full(N + 1, np.inf)
    limit[[0, -1]] = ends
    return drive(np.ones(N), np.zeros(N) + resistance, np.zeros(N) + slope, limit, machine)


def test_on_even_ground_energy_is_resistance_times_way_and_what_the_brakes_take() -> None:
    done = rolling(0.03, 0.0)
    assert done.energy_j.sum() - done.braked_j.sum() == pytest.approx(20_000 * GRAVITY_MPS2 * 0.03 * N)
    assert done.stalls == -1


def test_power_bounds_the_speed_uphill() -> None:
    done = rolling(0.03, 0.1)
    top = 200_000 / (20_000 * GRAVITY_MPS2 * 0.13)
    assert done.speed_mps[600:-200] == pytest.approx(np.full(N + 1 - 800, top), rel=1e-3)
    assert done.energy_j[300:-200].sum() == pytest.approx(200_000 * done.time_s[300:-200].sum(), rel=1e-6)


def test_a_machine_starts_and_stops_within_its_limits() -> None:
    done = rolling(0.02, 0.0, ends=0.0)
    change = np.diff(done.speed_mps**2) / 2
    assert done.speed_mps[0] == done.speed_mps[-1] == 0.0
    assert change.max() <= MACHINE.accelerate_mps2 + 1e-9
    assert change.min() >= -MACHINE.brake_mps2 - 1e-9
    assert done.speed_mps.max() == MACHINE.speed_mps
    # distance of constant acceleration
    start = int(np.argmax(done.speed_mps >= 4.0))
    assert start == pytest.approx(4.0**2 / 2 / MACHINE.accelerate_mps2, abs=1.0)
    assert done.time_s[:start].sum() == pytest.approx(4.0 / MACHINE.accelerate_mps2, rel=0.05)


def test_what_the_power_cannot_do_is_said() -> None:
    slope = np.zeros(N)
    slope[400:] = 2.0
    weak = RouteMachine(mass_kg=20_000.0, power_w=50_000.0)
    assert 50_000 / (20_000 * GRAVITY_MPS2 * 2.03) < CREEP_MPS
    done = rolling(0.03, slope, weak)
    assert 400 <= done.stalls <= 402
    assert rolling(0.03, 0.2, weak).stalls == -1
    slope[0] = 2.0
    assert rolling(0.03, slope, weak).stalls == 0, "the first of two"


def test_ground_is_smoothed_over_what_there_is() -> None:
    assert smoothed(np.array([1.0, 2.0, 9.0]), 0.5).tolist() == [4.0, 4.0, 4.0]
    assert smoothed(np.array([7.0]), 0.5).tolist() == [7.0]


def test_changes_of_the_ground_cost_what_drivers_answer_late() -> None:
    """By the size of the change, both ways; none where brakes hold throughout."""
    n = 200
    step, limit = np.ones(n), np.full(n + 1, np.inf)
    plain = RouteMachine(mass_kg=20_000.0, speed_mps=5.0, power_w=1e6)
    force = 20_000 * GRAVITY_MPS2 * 0.06
    soils = np.where(np.arange(n) < 100, 0.02, 0.08)
    level = np.zeros(n)
    for ground in (soils, soils[::-1]):
        done = drive(step, ground, level, limit, plain)
        late_j = 0.5 * LATE_S * 5.0 * force
        assert done.braked_j.sum() == pytest.approx(late_j)
        assert done.energy_j.sum() - late_j == pytest.approx(20_000 * GRAVITY_MPS2 * soils.sum())
    down = drive(step, soils, level - 0.2, limit, plain)
    assert down.energy_j.sum() == 0.0


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


def test_steps_divide_a_line_evenly_and_keep_its_length() -> None:
    assert steps(np.array([[0.0, 0.0], [3.0, 4.4]]), 1.0).length_m.sum() == pytest.approx(math.hypot(3.0, 4.4))
    assert len(steps(np.array([[0.0, 0.0], [0.1, 0.0]]), 1.0).length_m) == 1
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
