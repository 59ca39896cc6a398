from dataclasses import replace

import numpy as np
import pytest

from sim.terrain.terrain import SLIP_STIFFNESS, SOILS, TRACTION
from sim.worlds.bullet import TyreForces, Tyres, TyreState, WheelMotion, at_rest, radial_load, turn_wheels

STEP_S = 0.01
RADIUS_M, LOAD_N = 0.75, 43e3


def tyres(n: int) -> Tyres:
    return Tyres(*(np.full(n, v) for v in (RADIUS_M, 9e5, 4e4, 0.4, 172.3)))


def motion(speed: float, side: float, zone: int, load: float = LOAD_N) -> WheelMotion:
    return WheelMotion(np.array([load]), np.array([speed]), np.array([side]), np.array([zone]))


def rolling(speed: float) -> TyreState:
    return replace(at_rest((1,)), spin_radps=np.array([speed / RADIUS_M]))


def settle(
    state: TyreState, ground: WheelMotion, drive_nm: float = 0.0, brake_nm: float = 0.0, steps: int = 600
) -> tuple[TyreState, TyreForces]:
    for _ in range(steps):
        state, forces = turn_wheels(tyres(1), state, ground, np.array([drive_nm]), np.array([brake_nm]), STEP_S)
    return state, forces


@pytest.mark.parametrize("zone", range(5), ids=[s.name for s in SOILS])
@pytest.mark.parametrize("use", [-0.8, 0.1, 0.5, 0.9])
def test_steady_slip_follows_the_soil(zone: int, use: float) -> None:
    force = use * TRACTION[zone] * LOAD_N
    state, forces = settle(rolling(3.0), motion(3.0, 0.0, zone), force * RADIUS_M)
    rim = state.spin_radps[0] * RADIUS_M
    slip = (rim - 3.0) / max(rim, 3.0)
    assert forces.traction_n[0] == pytest.approx(force, rel=1e-6)
    assert slip == pytest.approx(np.arctanh(use) * TRACTION[zone] / SLIP_STIFFNESS[zone], rel=1e-3)


def test_forces_never_leave_the_friction_circle() -> None:
    rng = np.random.default_rng(3)
    n = 2000
    state = at_rest((n,))
    for _ in range(200):
        zone = rng.integers(0, 5, n)
        load = rng.uniform(0, 2e5, n) * (rng.random(n) > 0.1)
        ground = WheelMotion(load, rng.normal(0, 4, n), rng.normal(0, 2, n), zone)
        state, forces = turn_wheels(tyres(n), state, ground, rng.normal(0, 5e4, n), rng.exponential(2e4, n), STEP_S)
        assert (np.hypot(forces.traction_n, forces.left_n) <= TRACTION[zone] * load * (1 + 1e-9)).all()
        assert np.isfinite(state.spin_radps).all()


def test_wheel_in_the_air_meets_no_force_and_spins_up() -> None:
    state, forces = settle(rolling(1.0), motion(1.0, 0.3, 0, load=0.0), drive_nm=100.0, steps=10)
    assert forces.traction_n[0] == 0 == forces.left_n[0]
    assert forces.resistance_n[0] == 0
    assert state.spin_radps[0] == pytest.approx(1.0 / RADIUS_M + 100.0 * 10 * STEP_S / 172.3)


def test_side_force_builds_up_over_the_relaxation_length() -> None:
    slip, zone = 0.001, 0
    steady = settle(rolling(3.0), motion(3.0, -3.0 * slip, zone))[1].left_n[0]
    after_one_length = settle(rolling(1.0), motion(1.0, -1.0 * slip, zone), steps=40)[1].left_n[0]  # 0.4 m
    assert steady == pytest.approx(SLIP_STIFFNESS[zone] * slip * LOAD_N, rel=0.01)
    assert after_one_length / steady == pytest.approx(1 - np.exp(-1), abs=0.05)


def test_brake_holds_up_to_its_torque_and_slows_beyond() -> None:
    ground = motion(0.0, 0.0, 0)
    held, forces = settle(at_rest((1,)), ground, drive_nm=5e3, brake_nm=6e3)
    assert held.spin_radps[0] == 0
    assert forces.torque_nm[0] == pytest.approx(0.0, abs=1e-6)
    turned, _ = settle(at_rest((1,)), ground, drive_nm=9e3, brake_nm=6e3, steps=1)
    assert turned.spin_radps[0] > 0
    locked, sliding = settle(rolling(3.0), motion(3.0, 0.0, 0), brake_nm=1e6)
    assert locked.spin_radps[0] == 0
    assert sliding.traction_n[0] == pytest.approx(-TRACTION[0] * LOAD_N, rel=0.03)
    assert sliding.resistance_n[0] == 0


def test_ground_pushes_tyres_and_never_pulls() -> None:
    squash = np.array([-0.01, 0.05, 0.05, 0.05])
    rate = np.array([1.0, 0.0, 0.1, -5.0])
    np.testing.assert_allclose(radial_load(tyres(4), squash, rate), [0, 45e3, 49e3, 0])
