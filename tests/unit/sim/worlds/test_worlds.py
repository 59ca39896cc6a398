"""What holds in both worlds, the fast one and PyBullet's."""

import inspect
import math
from dataclasses import fields

import numpy as np
import pytest

from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import TRACTION_USE, Bodies
from sim.machines.model import MachineModel
from sim.state import STEP_S, FleetState, stack
from sim.terrain.soil import CONCRETE, SAND, SLIP_STIFFNESS, SOILS, TRACTION, WET_DIRT
from sim.worlds.bullet import BulletWorld
from sim.worlds.fast import FastWorld
from sim.worlds.world import World
from tests.unit.sim.bullet_worlds import BOTH, EACH, GRADE_15, LOADER, TRUCK, hold_speed, idle, placed, plane


@EACH
def test_worlds_offer_what_the_seam_asks_for(kind: type) -> None:
    for name in ("advance", "set_payload", "set_terrain", "close"):
        assert inspect.signature(getattr(kind, name)) == inspect.signature(getattr(World, name)), name
    assert inspect.signature(kind) == inspect.signature(FastWorld)


@EACH
def test_state_has_the_shapes_that_the_seam_promises(kind: type) -> None:
    vectors = {"rates_radps": 3, "rates_dot_radps2": 3, "force_mps2": 3, "wheel_radps": 2, "wheel_rad": 2}
    with placed(kind, plane(0), LOADER, TRUCK, LOADER, starts=[(500, 500 + 20 * i, i) for i in range(3)]) as world:
        for state in (world.state, world.advance(np.zeros(3), np.zeros(3), np.zeros(3))):
            for f in fields(FleetState):
                shape = (3, vectors[f.name]) if f.name in vectors else (3,)
                assert getattr(state, f.name).shape == shape, f.name
                assert getattr(state, f.name).dtype == np.float64, f.name
        assert world.state is state


@EACH
def test_past_states_do_not_change(kind: type) -> None:
    with placed(kind, plane(0), LOADER) as world:
        first = world.state
        before = {f.name: getattr(first, f.name).copy() for f in fields(FleetState)}
        hold_speed(world, 2.0, 0.5, 0.3)
        world.set_payload(0, 3000.0)
        for name, values in before.items():
            np.testing.assert_array_equal(getattr(first, name), values, err_msg=name)


@EACH
@BOTH
def test_machines_start_at_rest_where_they_are_put(kind: type, model: MachineModel) -> None:
    with placed(kind, plane(0), model, starts=[(480, 510, 0.7)]) as world:
        rest = world.state
    np.testing.assert_allclose(rest.force_mps2[0], [0, 0, GRAVITY_MPS2], atol=1e-3)
    np.testing.assert_allclose([rest.x_m[0], rest.y_m[0], rest.yaw_rad[0]], [480, 510, 0.7], atol=0.01)
    assert abs(rest.z_m[0]) < 1e-3
    assert abs(rest.rates_radps).max() < 1e-4
    assert abs(rest.speed_mps[0]) < 1e-4
    assert (rest.wheel_rad == 0).all()
    assert rest.load_n[0] == pytest.approx(model.mass_kg * GRAVITY_MPS2, rel=1e-3)


@EACH
@pytest.mark.parametrize("zone", range(5), ids=[s.name for s in SOILS])
def test_steady_traction_on_the_level_is_the_rolling_resistance(kind: type, zone: int) -> None:
    with placed(kind, plane(zone), LOADER) as world:
        last = hold_speed(world, 2.0, 7.0)[-1]
    ratio = last.torque_nm / LOADER.wheel_radius_m / last.load_n
    assert ratio[0] == pytest.approx(SOILS[zone].c_rr, rel=0.01)
    assert last.c_rr[0] == pytest.approx(SOILS[zone].c_rr)
    assert last.load_n[0] == pytest.approx(17_500 * GRAVITY_MPS2, rel=1e-3)


@EACH
@BOTH
@pytest.mark.parametrize("zone", [CONCRETE, WET_DIRT])
@pytest.mark.parametrize("uphill", [1, -1])
def test_steady_traction_on_15_degrees_adds_the_slope(kind: type, model: MachineModel, zone: int, uphill: int) -> None:
    with placed(kind, plane(zone, uphill * GRADE_15), model) as world:
        last = hold_speed(world, 2.0, 10.0)[-1]
    ratio = last.torque_nm / model.wheel_radius_m / last.load_n
    assert ratio[0] == pytest.approx(SOILS[zone].c_rr + uphill * GRADE_15, abs=0.002)
    assert last.load_n[0] == pytest.approx(model.mass_kg * GRAVITY_MPS2 * math.cos(math.radians(15)), rel=1e-3)
    assert math.degrees(last.pitch_rad[0]) == pytest.approx(-15 * uphill, abs=0.4)  # tyres give way by some mm


@EACH
@BOTH
@pytest.mark.parametrize("zone", [1, SAND])
def test_machine_rolls_out_by_its_resistance_and_stays(kind: type, model: MachineModel, zone: int) -> None:
    turning = 1 + 4 * model.wheel_inertia_kgm2 / model.wheel_radius_m**2 / model.mass_kg
    with placed(kind, plane(zone), model) as world:
        hold_speed(world, 5.0, 6.0)
        start = idle(world, 1.2).speed_mps[0]  # until the engine has let go
        slower = start - idle(world, 0.5).speed_mps[0]
        assert slower / 0.5 == pytest.approx(SOILS[zone].c_rr * GRAVITY_MPS2 / turning, rel=0.01)
        if zone == SAND:
            end = idle(world, 4.0)
            assert abs(end.speed_mps[0]) < 1e-3
            np.testing.assert_allclose(end.force_mps2[0], [0, 0, GRAVITY_MPS2], atol=0.01)


@EACH
@BOTH
@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2])
@pytest.mark.parametrize("zone", [CONCRETE, SAND])
def test_braked_machine_holds_on_15_degrees(kind: type, model: MachineModel, yaw: float, zone: int) -> None:
    with placed(kind, plane(zone, GRADE_15), model, starts=[(500, 500, yaw)]) as world:
        start = world.state
        end = idle(world, 30.0, model.max_brake_n)
    creep = math.hypot(end.x_m[0] - start.x_m[0], end.y_m[0] - start.y_m[0])
    assert creep < 0.01
    assert (end.wheel_radps == 0).all()


@EACH
@BOTH
@pytest.mark.parametrize("direction", [1, -1])
def test_brakes_stop_a_machine_and_never_push_it_back(kind: type, model: MachineModel, direction: int) -> None:
    with placed(kind, plane(CONCRETE), model) as world:
        start = hold_speed(world, 3.0 * direction, 5.0)[-1]
        brake = np.array([0.2 * model.mass_kg * GRAVITY_MPS2])
        states = stack([world.advance(np.zeros(1), np.zeros(1), brake) for _ in range(500)])
    along = direction * states.speed_mps[:, 0]
    slowing = (0.2 + SOILS[CONCRETE].c_rr) * GRAVITY_MPS2 / model.rotating_mass_factor
    assert (along[20] - along[90]) / 0.7 == pytest.approx(slowing, rel=0.02)
    assert start.speed_mps[0] * direction > 2.5
    assert along.min() > -0.08  # rocks on its tyres
    assert abs(along[-1]) < 1e-3
    np.testing.assert_allclose(states.wheel_radps[-1], 0, atol=1e-9)
    assert (direction * np.diff(states.wheel_rad[:, 0], axis=0)).min() > -1e-9


@EACH
@BOTH
def test_reversing_mirrors_driving(kind: type, model: MachineModel) -> None:
    with placed(kind, plane(WET_DIRT), model) as world:
        last = hold_speed(world, -2.0, 12.0)[-1]
        first = world.state
        turned = stack([first, *hold_speed(world, -2.0, 2.0, 0.3)])
    assert last.speed_mps[0] == pytest.approx(-2.0, abs=1e-3)
    assert last.x_m[0] < 485
    assert last.torque_nm[0] / model.wheel_radius_m / last.load_n[0] == pytest.approx(-SOILS[WET_DIRT].c_rr, rel=0.01)
    use = SOILS[WET_DIRT].c_rr
    slip = np.arctanh(use / TRACTION[WET_DIRT]) * TRACTION[WET_DIRT] / SLIP_STIFFNESS[WET_DIRT]
    np.testing.assert_allclose(last.wheel_radps[0] * model.wheel_radius_m, -2.0 / (1 - slip), rtol=0.005)
    assert (last.wheel_rad < -10).all()
    assert turned.rates_radps[-1, 0, 2] < -0.05  # left articulation backwards turns it to the right


@EACH
@BOTH
@pytest.mark.parametrize("steer", [0.2, -0.6])
def test_turning_radius_is_that_of_the_articulation(kind: type, model: MachineModel, steer: float) -> None:
    with placed(kind, plane(0), model) as world:
        states = stack(hold_speed(world, 2.0, 16.0, steer)[700:])
    x, y = states.x_m[:, 0], states.y_m[:, 0]
    # algebraic circle fit: x^2 + y^2 = 2 a x + 2 b y + c
    a, b, c = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
    kinematic = (model.front_to_joint_m + model.rear_to_joint_m * math.cos(steer)) / math.sin(abs(steer))
    assert math.sqrt(c + a * a + b * b) == pytest.approx(kinematic, rel=0.02)
    rates, speed = states.rates_radps[-1, 0], states.speed_mps[-1, 0]
    leaning = GRAVITY_MPS2 * math.sin(states.roll_rad[-1, 0])
    assert states.force_mps2[-1, 0, 1] - leaning == pytest.approx(speed * rates[2], rel=0.02)
    assert states.articulation_rad[-1, 0] == pytest.approx(steer, abs=1e-3)


@EACH
@BOTH
def test_steering_stays_within_its_limits(kind: type, model: MachineModel) -> None:
    with placed(kind, plane(0), model) as world:
        hold_speed(world, 1.0, 2.0)
        states = stack(hold_speed(world, 1.0, 5.0, 1.5))
    angle, rate = states.articulation_rad[:, 0], states.articulation_radps[:, 0]
    assert angle.max() == pytest.approx(model.max_articulation_rad, abs=2e-3)
    assert abs(rate).max() == pytest.approx(model.steer_radps, rel=0.02)
    np.testing.assert_allclose(np.diff(angle) / STEP_S, rate[1:], atol=0.01)
    np.testing.assert_allclose(np.diff(rate) / STEP_S, states.articulation_radps2[1:, 0], atol=1e-9)


@EACH
def test_state_says_what_is_carried(kind: type) -> None:
    with placed(kind, plane(0), LOADER, LOADER, starts=[(500, 500, 0), (500, 520, 0)]) as world:
        assert world.state.payload_kg.tolist() == [0.0, 0.0]
        world.set_payload(1, 3000.0)
        state = idle(world, 0.01)
        assert state.payload_kg.tolist() == [0.0, 3000.0]
        assert state.mass_kg.tolist() == [17_500.0, 20_500.0]


@EACH
@BOTH
def test_a_load_weighs_on_the_wheels(kind: type, model: MachineModel) -> None:
    with placed(kind, plane(2, 0.1), model, model, starts=[(500, 500, 0), (500, 520, 0)]) as world:
        for payload in (0.0, model.payload_kg, 0.0):
            world.set_payload(1, payload)
            last = idle(world, 4.0, 2 * model.max_brake_n)
            np.testing.assert_allclose(last.mass_kg, [model.mass_kg, model.mass_kg + payload])
            np.testing.assert_allclose(last.load_n, last.mass_kg * GRAVITY_MPS2 / math.hypot(1, 0.1), rtol=1e-3)


@EACH
def test_a_load_slows_a_machine_down(kind: type) -> None:
    gained = []
    for payload in (0.0, TRUCK.payload_kg):
        with placed(kind, plane(CONCRETE), TRUCK) as world:
            world.set_payload(0, payload)
            idle(world, 2.0, TRUCK.max_brake_n)
            for _ in range(300):
                state = world.advance(np.zeros(1), np.full(1, 50e3), np.zeros(1))
        gained.append(state.accel_mps2[0])
        rolling = 4 * TRUCK.wheel_inertia_kgm2 / TRUCK.wheel_radius_m**2
        expected = (50e3 - SOILS[CONCRETE].c_rr * state.load_n[0]) / (state.mass_kg[0] + rolling)
        assert state.accel_mps2[0] == pytest.approx(expected, rel=0.02)
    assert gained[1] < 0.6 * gained[0]


@EACH
def test_repaved_ground_acts_on_machines(kind: type) -> None:
    with placed(kind, plane(CONCRETE), LOADER) as world:
        hold_speed(world, 2.0, 4.0)
        assert world.state.c_rr[0] == pytest.approx(SOILS[CONCRETE].c_rr)
        world.set_terrain(plane(SAND))
        last = hold_speed(world, 2.0, 6.0)[-1]
    assert last.c_rr[0] == pytest.approx(SOILS[SAND].c_rr)
    assert last.torque_nm[0] / LOADER.wheel_radius_m / last.load_n[0] == pytest.approx(SOILS[SAND].c_rr, rel=0.01)


@EACH
@BOTH
@pytest.mark.parametrize("grade", [0.0, GRADE_15])
def test_traction_control_keeps_wheels_from_spinning_up(kind: type, model: MachineModel, grade: float) -> None:
    with placed(kind, plane(SAND, grade), model) as world:
        for _ in range(500):
            state = world.advance(np.zeros(1), np.full(1, 1e6), np.zeros(1))
    most = TRACTION_USE * TRACTION[SAND] * state.load_n[0]
    assert state.drive_n[0] == pytest.approx(most, rel=0.01)
    assert state.torque_nm[0] == pytest.approx(most * model.wheel_radius_m, rel=0.01)
    slip = 1 - state.speed_mps[0] / (state.wheel_radps[0] * model.wheel_radius_m)
    assert state.speed_mps[0] > 0.5
    assert slip.max() < 0.5


@EACH
@BOTH
@pytest.mark.parametrize("yaw", [0.3, -2.0])
def test_grade_and_attitude_are_those_of_the_plane(kind: type, model: MachineModel, yaw: float) -> None:
    with placed(kind, plane(0, 0.12, -0.07), model, starts=[(500, 500, yaw)]) as world:
        rest = world.state
    assert rest.grade_e[0] == pytest.approx(0.12, abs=1e-6)
    assert rest.grade_n[0] == pytest.approx(-0.07, abs=1e-6)
    up = np.array([-0.12, 0.07, 1.0]) / math.sqrt(1 + 0.12**2 + 0.07**2)
    c, s = np.cos(yaw), np.sin(yaw)
    up_seen = rest.force_mps2[0] / GRAVITY_MPS2  # the vertical as the rear frame sees it
    np.testing.assert_allclose(up_seen[:2], [-up[0] * c - up[1] * s, up[0] * s - up[1] * c], atol=0.01)


@EACH
def test_true_bodies_differ_from_the_model(kind: type) -> None:
    world = kind(plane(0), [LOADER], Bodies(np.array([18_000.0]), np.array([0.76])), np.array([[500, 500, 0.0]]))
    assert world.state.load_n[0] == pytest.approx(18_000 * GRAVITY_MPS2, rel=1e-4)
    last = hold_speed(world, 2.0, 5.0)[-1]
    assert last.wheel_radps[0, 0] * 0.76 == pytest.approx(last.speed_mps[0], rel=1e-3)
    world.close()


@BOTH
def test_both_worlds_take_the_same_track_under_the_same_commands(model: MachineModel) -> None:
    weight_n, runs = model.mass_kg * GRAVITY_MPS2, []
    for kind in (FastWorld, BulletWorld):
        with placed(kind, plane(2, 0.03, -0.02), model, starts=[(500, 500, 0.4)]) as world:
            states = []
            for i in range(1600):
                # off, straight, to the left, and a stop
                steer, drive, brake = np.array([[0.3 * (i > 600)], [0.1 * (i < 1200)], [0.2 * (i > 1200)]])
                states.append(world.advance(steer, drive * weight_n, brake * weight_n))
            runs.append(stack(states))
    fast, bullet = runs
    driven = np.hypot(np.diff(fast.x_m[:, 0]), np.diff(fast.y_m[:, 0])).cumsum()
    apart = np.hypot(fast.x_m - bullet.x_m, fast.y_m - bullet.y_m)[:, 0]
    assert driven[599] > 5
    assert driven[-1] > 30
    assert apart[599] < 0.006 * driven[599]
    assert apart.max() < 0.03 * driven[-1]  # steering pushes PyBullet's frames a little ahead
    assert abs(fast.yaw_rad - bullet.yaw_rad).max() < 0.1
    np.testing.assert_allclose(fast.articulation_rad, bullet.articulation_rad, atol=0.01)
    np.testing.assert_allclose(fast.drive_n, bullet.drive_n, atol=1.0)
    np.testing.assert_allclose(fast.wheel_rad[-1], bullet.wheel_rad[-1], rtol=0.05)
