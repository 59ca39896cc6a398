import math

import numpy as np
import pytest

from sim import paper_site
from sim.driver import MAX_ARTICULATION_RAD
from sim.fleet import Fleet
from sim.paper_site import SLOPE_FOOT_M, SLOPE_TOP_M
from sim.soil import SOILS
from sim.terrain import Terrain
from sim.vehicle import GRAVITY, WHEEL_INERTIA_KG, Bodies, advance, standing
from sim.world import STEP_S, FleetState, stack

BODY = Bodies(np.array([17_500.0]), np.array([0.75]))


def plane(zone: int, grade_east: float = 0.0, grade_north: float = 0.0) -> Terrain:
    x, y = np.meshgrid([-500.0, 500.0], [-500.0, 500.0])
    heights = grade_east * x + grade_north * y  # a plane shifted by its corner: only the gradient matters
    return Terrain(heights, 1000.0, np.full((1, 1), zone), 1000.0)


def drive_on(terrain: Terrain, speed: float, seconds: float, steer: float = 0.0, yaw: float = 0.0) -> list[FleetState]:
    """One machine held at a speed from the middle of a plane."""
    state = standing(BODY, terrain, np.array([500.0]), np.array([500.0]), np.array([yaw]))
    states, integral = [], 0.0
    for i in range(round(seconds / STEP_S)):
        error = min(speed, 0.8 * i * STEP_S) - float(state.speed_mps[0])
        integral += 40e3 * STEP_S * error
        state = advance(BODY, terrain, state, np.array([steer]), np.array([50e3 * error + integral]), STEP_S)
        states.append(state)
    return states


@pytest.mark.parametrize("zone", range(5), ids=[s.name for s in SOILS])
def test_steady_traction_on_the_level_is_the_rolling_resistance(zone: int) -> None:
    last = drive_on(plane(zone), 3.0, 10.0)[-1]
    ratio = last.torque_nm / BODY.wheel_radius_m / last.load_n
    assert ratio[0] == pytest.approx(SOILS[zone].c_rr, rel=0.01)
    assert last.c_rr[0] == pytest.approx(SOILS[zone].c_rr)


@pytest.mark.parametrize("zone", [0, 1, 2, 3], ids=[s.name for s in SOILS[:4]])
@pytest.mark.parametrize("uphill", [1, -1])
def test_steady_traction_on_15_degrees_adds_the_slope(zone: int, uphill: int) -> None:
    tangent = math.tan(math.radians(15))
    last = drive_on(plane(zone, grade_east=uphill * tangent), 2.0, 11.0)[-1]
    assert last.drive_n[0] / last.load_n[0] == pytest.approx(SOILS[zone].c_rr + uphill * tangent, abs=0.005)
    assert last.load_n[0] == pytest.approx(17_500 * GRAVITY * math.cos(math.radians(15)), rel=1e-3)
    assert math.degrees(last.pitch_rad[0]) == pytest.approx(-15 * uphill, abs=0.05)


def test_the_estimators_equation_holds_at_every_instant() -> None:
    # F/m - f_x - (lambda-1) dv = c g cos(theta): the accelerometer contains gravity's share (DESIGN)
    for state in drive_on(plane(3, grade_east=0.1, grade_north=0.05), 3.0, 6.0, yaw=0.4)[200:]:
        left = state.drive_n / 17_500 - state.force_mps2[:, 0] - WHEEL_INERTIA_KG / 17_500 * state.accel_mps2
        assert left[0] == pytest.approx(0.06 * state.load_n[0] / 17_500, abs=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_grade_and_attitude_are_those_of_the_plane(yaw: float) -> None:
    last = drive_on(plane(0, 0.12, -0.07), 2.0, 8.0, steer=0.2, yaw=yaw)[-1]
    assert last.grade_e[0] == pytest.approx(0.12, abs=1e-9)
    assert last.grade_n[0] == pytest.approx(-0.07, abs=1e-9)
    normal = np.array([-0.12, 0.07, 1.0]) / math.sqrt(1 + 0.12**2 + 0.07**2)
    tilt = math.cos(last.pitch_rad[0]) * math.cos(last.roll_rad[0])
    assert tilt == pytest.approx(normal[2], abs=2e-3)


def test_at_rest_the_specific_force_is_gravity_upwards() -> None:
    state = standing(BODY, plane(0, 0.2, 0.1), np.array([500.0]), np.array([500.0]), np.array([0.7]))
    assert np.linalg.norm(state.force_mps2) == pytest.approx(GRAVITY)
    level = standing(BODY, plane(0), np.array([500.0]), np.array([500.0]), np.array([0.7]))
    np.testing.assert_allclose(level.force_mps2[0], [0, 0, GRAVITY], atol=1e-12)


@pytest.mark.parametrize("steer", [0.2, -0.4, 0.6])
def test_turning_radius_is_that_of_the_articulation(steer: float) -> None:
    states = stack(drive_on(plane(0), 2.0, 10.0, steer)[600:])
    x, y = states.x_m[:, 0], states.y_m[:, 0]
    # algebraic circle fit: x^2 + y^2 = 2 a x + 2 b y + c
    a, b, c = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
    assert math.sqrt(c + a * a + b * b) == pytest.approx(1.65 / math.tan(abs(steer) / 2), rel=1e-3)
    rates, speed = states.rates_radps[-1, 0], states.speed_mps[-1, 0]
    assert rates[2] == pytest.approx(speed * math.tan(steer / 2) / 1.65, rel=1e-6)
    assert states.force_mps2[-1, 0, 1] == pytest.approx(speed * rates[2], rel=1e-3)


def test_inner_wheel_turns_more_slowly() -> None:
    last = drive_on(plane(0), 2.0, 10.0, steer=0.4)[-1]
    left, right = last.wheel_radps[0]
    assert (right - left) * 0.75 == pytest.approx(2.2 * last.rates_radps[0, 2], rel=0.02)


def test_wheels_slip_more_on_soft_ground_and_less_when_braking() -> None:
    slips = []
    for zone in (0, 4):
        last = drive_on(plane(zone), 3.0, 10.0)[-1]
        slips.append(last.wheel_radps[0, 0] * 0.75 / last.speed_mps[0])
    assert 1.0 < slips[0] < 1.001
    assert 1.05 < slips[1] < 1.2
    downhill = drive_on(plane(0, grade_east=-0.2), 2.0, 8.0)[-1]
    assert 0.95 < downhill.wheel_radps[0, 0] * 0.75 / downhill.speed_mps[0] < 1.0


def test_machine_rolls_out_by_its_resistance_and_stays() -> None:
    terrain = plane(1)
    state = drive_on(terrain, 3.0, 10.0)[-1]
    start, speed = float(state.x_m[0]), float(state.speed_mps[0])
    for _ in range(2700):
        state = advance(BODY, terrain, state, np.zeros(1), np.zeros(1), STEP_S)
    way = speed**2 / (2 * 0.02 * GRAVITY) * (1 + WHEEL_INERTIA_KG / 17_500)
    assert state.x_m[0] - start == pytest.approx(way, rel=0.05)
    assert abs(state.speed_mps[0]) < 0.01


@pytest.fixture(scope="module")
def tour() -> tuple[FleetState, list[np.ndarray]]:
    """Six machines for 125 s on rough ground: every tour in both directions, a whole lap."""
    routes = [paper_site.route_of(i) for i in range(6)]
    terrain = paper_site.terrain(5, 0.01)
    fleet = Fleet(terrain, Bodies(np.full(6, 18_000.0), np.full(6, 0.75)), routes, 4.0)
    states = [fleet.step() for _ in range(12_500)]
    return stack(states[::10]), [r.points for r in routes]


def test_nobody_gets_stuck(tour: tuple[FleetState, list[np.ndarray]]) -> None:
    states, routes = tour
    assert states.speed_mps[100:].min() > 1.5
    assert states.speed_mps.max() < 5.5
    lap = np.array([0.5 * len(points) for points in routes])
    assert (states.speed_mps.sum(axis=0) * 0.1 > lap).all()


def test_machines_keep_to_their_routes_and_steer_within_the_limit(tour: tuple[FleetState, list[np.ndarray]]) -> None:
    states, routes = tour
    for i, points in enumerate(routes):
        off = np.hypot(states.x_m[::5, i, None] - points[:, 0], states.y_m[::5, i, None] - points[:, 1]).min(axis=1)
        assert off.max() < 1.0, i
    assert abs(states.articulation_rad).max() <= MAX_ARTICULATION_RAD


def test_three_machines_see_all_zones_and_the_slope_in_120_s(tour: tuple[FleetState, list[np.ndarray]]) -> None:
    states, _ = tour
    x, y, speed = (v[:1200, :3] for v in (states.x_m, states.y_m, states.speed_mps))
    zones = paper_site.terrain(5, 0.0).zone(x, y)
    metres = np.bincount(zones.ravel(), (speed * 0.1).ravel(), minlength=5)
    assert metres.min() > 80, metres
    assert (speed * 0.1)[(x > SLOPE_FOOT_M) & (x < SLOPE_TOP_M)].sum() > 80


def test_body_moves_smoothly(tour: tuple[FleetState, list[np.ndarray]]) -> None:
    states, _ = tour
    assert np.isfinite(states.force_mps2).all()
    assert abs(states.force_mps2[:, :, 2] - GRAVITY).max() < 3.0
    assert abs(states.rates_radps).max() < 0.6
