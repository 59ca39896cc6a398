"""Laws of both worlds."""

import math
from collections.abc import Sequence
from dataclasses import fields
from itertools import product

import numpy as np
import pytest

from agents.estimation.balance import squat_rad
from protocol.units import GRAVITY_MPS2
from sim.machines.chassis import TRACTION_USE, Bodies
from sim.machines.model import MachineModel
from sim.sensors.presets import load_preset
from sim.sensors.rigs import machine_config
from sim.state import STEP_S, FleetState, stack
from sim.terrain.terrain import CONCRETE, SAND, SLIP_STIFFNESS, SOILS, TRACTION, WET_DIRT
from sim.worlds.bullet import BulletWorld
from sim.worlds.fast import FastWorld
from tests.unit.sim.planes import (
    BOTH,
    EACH,
    EACH_ALWAYS,
    GRADE_15,
    LOADER,
    TRUCK,
    Lane,
    cruise,
    idle,
    lanes,
    of_each,
    placed,
    plane,
)

MODELS = (LOADER, TRUCK)


@EACH_ALWAYS
def test_state_has_the_shapes_that_the_seam_promises(kind: type) -> None:
    vectors = {"rates_radps": 3, "rates_dot_radps2": 3, "force_mps2": 3, "wheel_radps": 2, "wheel_rad": 2}
    with placed(kind, plane(0), LOADER, TRUCK, LOADER, starts=[(500, 500 + 20 * i, i) for i in range(3)]) as world:
        for state in (world.state, world.advance(np.zeros(3), np.zeros(3), np.zeros(3))):
            for f in fields(FleetState):
                shape = (3, vectors[f.name]) if f.name in vectors else (3,)
                assert getattr(state, f.name).shape == shape, f.name
                assert getattr(state, f.name).dtype == np.float64, f.name
        assert world.state is state


@EACH_ALWAYS
def test_past_states_do_not_change(kind: type) -> None:
    with placed(kind, plane(0), LOADER) as world:
        first = world.state
        before = {f.name: getattr(first, f.name).copy() for f in fields(FleetState)}
        cruise(world, 2.0, 0.5, 0.3)
        world.set_payload(0, 3000.0)
        for name, values in before.items():
            np.testing.assert_array_equal(getattr(first, name), values, err_msg=name)


def load_of(lanes: Sequence[Lane], slope_rad: float = 0.0) -> np.ndarray:
    return of_each(lanes, "mass_kg") * GRAVITY_MPS2 * math.cos(slope_rad)


def soil_of(lanes: Sequence[Lane]) -> np.ndarray:
    return np.array([SOILS[lane.zone].c_rr for lane in lanes])


def traction_of(lanes: Sequence[Lane], state: FleetState) -> np.ndarray:
    return state.torque_nm / of_each(lanes, "wheel_radius_m") / state.load_n


@EACH
def test_steady_traction_on_the_level_is_the_rolling_resistance(kind: type) -> None:
    soils = [Lane(zone=zone) for zone in range(5)]
    with lanes(kind, soils) as world:
        last = cruise(world, 2.0, 7.0)[-1]
    np.testing.assert_allclose(traction_of(soils, last), soil_of(soils), rtol=0.01)
    np.testing.assert_allclose(last.c_rr, soil_of(soils))
    np.testing.assert_allclose(last.load_n, load_of(soils), rtol=1e-3)


@EACH
@pytest.mark.parametrize("grade", [0.15, -0.2])
def test_wheels_slip_as_the_soil_table_says(kind: type, grade: float) -> None:
    zones, direction = [0, SAND, 0, SAND], np.array([1, 1, -1, -1])
    with lanes(kind, [Lane(zone=zone) for zone in zones], grade) as world:
        last = cruise(world, 2.0 * direction, 10.0)[-1]
    use = direction * last.torque_nm / LOADER.wheel_radius_m / last.load_n
    slip = np.arctanh(use / TRACTION[zones]) * TRACTION[zones] / SLIP_STIFFNESS[zones]
    for wheel in (last.wheel_radps * LOADER.wheel_radius_m).T:
        measured = (wheel - last.speed_mps) / np.maximum(abs(wheel), abs(last.speed_mps)) * direction
        np.testing.assert_allclose(measured, slip, rtol=1e-3 if kind is FastWorld else 0.02)


@EACH_ALWAYS
def test_steady_traction_on_15_degrees_adds_the_slope(kind: type) -> None:
    cases = [Lane(*case) for case in product(MODELS, (CONCRETE, WET_DIRT), (0.0, math.pi))]
    uphill = np.array([1 if lane.yaw == 0 else -1 for lane in cases])
    with lanes(kind, cases, GRADE_15) as world:
        last = cruise(world, 2.0, 10.0)[-1]
    np.testing.assert_allclose(traction_of(cases, last), soil_of(cases) + uphill * GRADE_15, atol=0.002)
    np.testing.assert_allclose(last.load_n, load_of(cases, math.radians(15)), rtol=1e-3)
    np.testing.assert_allclose(np.degrees(last.pitch_rad), -15 * uphill, atol=0.4)  # tyres yield by millimetres


@EACH
def test_machine_rolls_out_by_its_resistance_and_stays(kind: type) -> None:
    cases = [Lane(*case) for case in product(MODELS, (1, SAND))]
    radius, mass, wheel = (of_each(cases, name) for name in ("wheel_radius_m", "mass_kg", "wheel_inertia_kgm2"))
    with lanes(kind, cases) as world:
        cruise(world, 5.0, 6.0)
        start = idle(world, 1.2).speed_mps  # until the engine has let go
        slower = start - idle(world, 0.5).speed_mps
        end = idle(world, 4.0)
    expected = soil_of(cases) * GRAVITY_MPS2 / (1 + 4 * wheel / radius**2 / mass)
    np.testing.assert_allclose(slower / 0.5, expected, rtol=0.01)
    stands = soil_of(cases) > 0.2
    assert stands.any()
    assert abs(end.speed_mps[stands]).max() < 1e-3
    np.testing.assert_allclose(end.force_mps2[stands] - [0, 0, GRAVITY_MPS2], 0, atol=0.01)


@pytest.mark.slow
@EACH
def test_braked_machine_holds_on_15_degrees(kind: type) -> None:
    cases = [Lane(*case) for case in product(MODELS, (CONCRETE, SAND), (0.0, 0.7, math.pi / 2))]
    with lanes(kind, cases, GRADE_15) as world:
        start = world.state
        end = idle(world, 15.0, of_each(cases, "max_brake_n"))
    assert np.hypot(end.x_m - start.x_m, end.y_m - start.y_m).max() < 0.01
    assert (end.wheel_radps == 0).all()


@EACH
def test_brakes_stop_a_machine_and_never_drive_it_back(kind: type) -> None:
    cases = [Lane(model) for model in (LOADER, TRUCK, LOADER, TRUCK)]
    direction = np.array([1, 1, -1, -1])
    zero = np.zeros(4)
    with lanes(kind, cases) as world:
        start = cruise(world, 3.0 * direction, 5.0)[-1]
        states = stack([world.advance(zero, zero, 0.2 * load_of(cases)) for _ in range(500)])
    along = direction * states.speed_mps
    slowing = (0.2 + SOILS[CONCRETE].c_rr) * GRAVITY_MPS2 / of_each(cases, "rotating_mass_factor")
    np.testing.assert_allclose((along[20] - along[90]) / 0.7, slowing, rtol=0.02)
    assert (start.speed_mps * direction).min() > 2.5
    assert along.min() > -0.08  # rocks on its tyres
    assert abs(along[-1]).max() < 1e-3
    np.testing.assert_allclose(states.wheel_radps[-1], 0, atol=1e-9)
    assert (direction[:, None] * np.diff(states.wheel_rad, axis=0)).min() > -1e-9


@EACH
def test_reversing_mirrors_driving(kind: type) -> None:
    cases = [Lane(model, WET_DIRT) for model in MODELS]
    with lanes(kind, cases) as world:
        last = cruise(world, -2.0, 12.0)[-1]
        turned = cruise(world, -2.0, 2.0, 0.3)[-1]
    np.testing.assert_allclose(last.speed_mps, -2.0, atol=1e-3)
    assert last.x_m.max() < 485
    use = SOILS[WET_DIRT].c_rr
    np.testing.assert_allclose(traction_of(cases, last), -use, rtol=0.01)
    slip = np.arctanh(use / TRACTION[WET_DIRT]) * TRACTION[WET_DIRT] / SLIP_STIFFNESS[WET_DIRT]
    wheel_mps = last.wheel_radps * of_each(cases, "wheel_radius_m")[:, None]
    np.testing.assert_allclose(wheel_mps, -2.0 / (1 - slip), rtol=0.005)
    assert (last.wheel_rad < -10).all()
    assert turned.rates_radps[:, 2].max() < -0.05  # left articulation in reverse turns right


@EACH
def test_turning_radius_is_that_of_the_articulation(kind: type) -> None:
    cases = [Lane(model) for model in (LOADER, TRUCK, LOADER, TRUCK)]
    steer = np.array([0.2, 0.2, -0.6, -0.6])
    with lanes(kind, cases) as world:
        states = stack(cruise(world, 2.0, 12.0, steer)[600:])
    rear, front = of_each(cases, "rear_to_joint_m"), of_each(cases, "front_to_joint_m")
    kinematic = (front + rear * np.cos(steer)) / np.sin(abs(steer))
    for i, radius in enumerate(kinematic):
        x, y = states.x_m[:, i], states.y_m[:, i]
        # algebraic circle fit: x^2 + y^2 = 2 a x + 2 b y + c
        a, b, c = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
        assert math.sqrt(c + a * a + b * b) == pytest.approx(radius, rel=0.02)
    leaning = GRAVITY_MPS2 * np.sin(states.roll_rad[-1])
    sideways = states.speed_mps[-1] * states.rates_radps[-1, :, 2]
    np.testing.assert_allclose(states.force_mps2[-1, :, 1] - leaning, sideways, rtol=0.02)
    np.testing.assert_allclose(states.articulation_rad[-1], steer, atol=1e-3)
    left, right = states.wheel_radps[-1].T * of_each(cases, "wheel_radius_m")
    np.testing.assert_allclose(right - left, of_each(cases, "track_m") * states.rates_radps[-1, :, 2], rtol=0.02)


@EACH
def test_steering_stays_within_its_limits(kind: type) -> None:
    cases = [Lane(model) for model in MODELS]
    with lanes(kind, cases) as world:
        cruise(world, 1.0, 2.0)
        states = stack(cruise(world, 1.0, 5.0, 1.5))
    angle, rate = states.articulation_rad, states.articulation_radps
    np.testing.assert_allclose(angle.max(axis=0), of_each(cases, "max_articulation_rad"), atol=2e-3)
    np.testing.assert_allclose(abs(rate).max(axis=0), of_each(cases, "steer_radps"), rtol=0.02)
    np.testing.assert_allclose(np.diff(angle, axis=0) / STEP_S, rate[1:], atol=0.01)
    np.testing.assert_allclose(np.diff(rate, axis=0) / STEP_S, states.articulation_radps2[1:], atol=1e-9)


@EACH
def test_a_load_weighs_on_the_wheels(kind: type) -> None:
    cases = [Lane(model, 2) for model in (LOADER, TRUCK, LOADER, TRUCK)]
    with lanes(kind, cases, 0.1) as world:
        for share in (0.0, 1.0, 0.0):
            for machine in (2, 3):
                world.set_payload(machine, share * cases[machine].model.payload_kg)
            last = idle(world, 4.0, 2 * of_each(cases, "max_brake_n"))
            payload = share * of_each(cases, "payload_kg") * [0, 0, 1, 1]
            assert last.payload_kg.tolist() == payload.tolist()
            np.testing.assert_allclose(last.mass_kg, of_each(cases, "mass_kg") + payload)
            np.testing.assert_allclose(last.load_n, last.mass_kg * GRAVITY_MPS2 / math.hypot(1, 0.1), rtol=1e-3)


@EACH
def test_repaved_ground_acts_on_machines(kind: type) -> None:
    with placed(kind, plane(CONCRETE), LOADER) as world:
        cruise(world, 2.0, 4.0)
        assert world.state.c_rr[0] == pytest.approx(SOILS[CONCRETE].c_rr)
        world.set_terrain(plane(SAND))
        last = cruise(world, 2.0, 6.0)[-1]
    assert last.c_rr[0] == pytest.approx(SOILS[SAND].c_rr)
    assert last.torque_nm[0] / LOADER.wheel_radius_m / last.load_n[0] == pytest.approx(SOILS[SAND].c_rr, rel=0.01)


@EACH
@pytest.mark.parametrize("grade", [0.0, GRADE_15])
def test_traction_control_keeps_wheels_from_spinning_up(kind: type, grade: float) -> None:
    cases = [Lane(model, SAND) for model in MODELS]
    with lanes(kind, cases, grade) as world:
        for _ in range(500):
            state = world.advance(np.zeros(2), np.full(2, 1e6), np.zeros(2))
    most = TRACTION_USE * TRACTION[SAND] * state.load_n
    np.testing.assert_allclose(state.drive_n, most, rtol=0.01)
    radius = of_each(cases, "wheel_radius_m")
    np.testing.assert_allclose(state.torque_nm, most * radius, rtol=0.01)
    slip = 1 - state.speed_mps[:, None] / (state.wheel_radps * radius[:, None])
    assert state.speed_mps.min() > 0.5
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
    up_seen = rest.force_mps2[0] / GRAVITY_MPS2  # vertical in the rear frame
    np.testing.assert_allclose(up_seen[:2], [-up[0] * c - up[1] * s, up[0] * s - up[1] * c], atol=0.01)


@EACH_ALWAYS
def test_true_bodies_differ_from_the_model(kind: type) -> None:
    world = kind(plane(0), [LOADER], Bodies(np.array([18_000.0]), np.array([0.76])), np.array([[500, 500, 0.0]]))
    assert world.state.load_n[0] == pytest.approx(18_000 * GRAVITY_MPS2, rel=1e-4)
    last = cruise(world, 2.0, 5.0)[-1]
    assert last.wheel_radps[0, 0] * 0.76 == pytest.approx(last.speed_mps[0], rel=1e-3)
    world.close()


@EACH_ALWAYS
def test_soft_tyres_take_more_torque_on_the_same_ground(kind: type) -> None:
    nominal = np.full(2, LOADER.mass_kg), np.full(2, LOADER.wheel_radius_m)
    starts = np.array([[500, 500, 0.0], [500, 520, 0.0]])
    world = kind(plane(0), [LOADER] * 2, Bodies(*nominal, rolling=np.array([1.0, 1.25])), starts)
    torque_nm, c_rr = np.mean([(s.torque_nm, s.c_rr) for s in cruise(world, 2.0, 8.0)[-100:]], axis=0)
    world.close()
    assert torque_nm[1] / torque_nm[0] == pytest.approx(1.25, rel=0.01)
    assert c_rr[0] == c_rr[1]


@pytest.mark.slow
def test_both_worlds_take_the_same_track_under_the_same_commands() -> None:
    cases = [Lane(model, 2, 0.4) for model in MODELS]
    weight_n, runs = load_of(cases), []
    for kind in (FastWorld, BulletWorld):
        with lanes(kind, cases, 0.02) as world:
            states = []
            for i in range(1500):
                # off, straight, left, stop
                steer, drive, brake = 0.3 * (i > 600), 0.1 * (i < 1200), 0.2 * (i > 1200)
                states.append(world.advance(np.full(2, steer), drive * weight_n, brake * weight_n))
            runs.append(stack(states))
    fast, bullet = runs
    driven = np.hypot(np.diff(fast.x_m, axis=0), np.diff(fast.y_m, axis=0)).cumsum(axis=0)
    apart = np.hypot(fast.x_m - bullet.x_m, fast.y_m - bullet.y_m)
    assert driven[599].min() > 5
    assert driven[-1].min() > 30
    assert (apart[599] < 0.006 * driven[599]).all()
    assert (apart.max(axis=0) < 0.03 * driven[-1]).all()  # steering pushes PyBullet's frames slightly ahead
    assert abs(fast.yaw_rad - bullet.yaw_rad).max() < 0.1
    np.testing.assert_allclose(fast.articulation_rad, bullet.articulation_rad, atol=0.01)
    np.testing.assert_allclose(fast.drive_n, bullet.drive_n, atol=1.0)
    np.testing.assert_allclose(fast.wheel_rad[-1], bullet.wheel_rad[-1], rtol=0.05)


@pytest.mark.slow
@EACH
@pytest.mark.parametrize("slope_deg", [0, 15])
def test_squat_at_steady_speed_is_that_of_the_axles_loads(kind: type, slope_deg: int) -> None:
    cases = [Lane(model, 1, yaw) for model in (LOADER, TRUCK) for yaw in (0.0, 0.0, math.pi, math.pi)]
    payload_kg = of_each(cases, "payload_kg") * ([0, 1] * 4)  # empty and full
    with lanes(kind, cases, math.tan(math.radians(slope_deg))) as world:
        for i, payload in enumerate(payload_kg.tolist()):
            world.set_payload(i, payload)
        idle(world, 3.0, of_each(cases, "max_brake_n"))
        last = stack(cruise(world, 2.0, 8.0)[-100:])
    for i, case in enumerate(cases):
        slope = math.radians(slope_deg) * math.cos(case.yaw)
        nose_up = -last.pitch_rad[:, i].mean() - slope
        force_x = GRAVITY_MPS2 * math.sin(slope) + float(last.accel_mps2[:, i].mean())
        machine = machine_config("a", case.model, load_preset("dgps"), (), (), ())
        assert nose_up == pytest.approx(squat_rad(machine, payload_kg[i], force_x), abs=0.0005)
        if payload_kg[i] or slope_deg:
            assert abs(nose_up) > 0.002  # else nothing to see


def test_head_on_collision_stays_finite_and_nobody_passes_through() -> None:
    with placed(BulletWorld, plane(1), LOADER, LOADER, starts=[(490, 500, 0), (508, 500.3, math.pi)]) as world:
        states = []
        for _ in range(800):
            drive = np.clip(50e3 * (4.0 - world.state.speed_mps), -80e3, 100e3)
            states.append(world.advance(np.zeros(2), drive, np.zeros(2)))
    run = stack(states)
    assert all(np.isfinite(getattr(run, f.name)).all() for f in fields(FleetState))
    gap = np.hypot(run.x_m[:, 1] - run.x_m[:, 0], run.y_m[:, 1] - run.y_m[:, 0])
    assert run.speed_mps[:, 0].max() > 2.5
    assert gap.min() > 2 * 5.25 - 0.3  # rear axle to bucket, twice
    assert abs(run.speed_mps[-1]).max() < 0.1
    assert abs(run.roll_rad).max() < 0.2
