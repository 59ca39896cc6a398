"""Drives with known answers: energy is resistance, height and speed; power, curves and brakes bound the speed."""

import numpy as np
import pytest

from mapserver.routes.drive import CREEP_MPS, LATE_S, Drive, drive
from protocol.arrays import Floats
from protocol.queries.routing import RouteMachine
from protocol.units import GRAVITY_MPS2

MACHINE = RouteMachine(mass_kg=20_000.0, speed_mps=8.0, power_w=200_000.0)
N = 1000


def rolling(
    resistance: float | Floats, slope: float | Floats, machine: RouteMachine = MACHINE, ends: float = 2.0
) -> Drive:
    """A drive of N steps of 1 m that begins and ends at a speed."""
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
    # the way of even acceleration, as in a textbook
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


def test_changes_of_the_ground_cost_what_drivers_answer_late() -> None:
    """By the size of the change, there and back alike; where brakes hold all the time, nothing."""
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
