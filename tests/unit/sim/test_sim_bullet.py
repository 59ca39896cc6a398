import hashlib
import math
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pybullet
import pytest
from sim_bullet_worlds import GRADE_15, LOADER, TRUCK, bullet, hold_speed, idle, plane

from sim.bullet import BulletWorld
from sim.machine_model import MachineModel
from sim.soil import SAND, SLIP_STIFFNESS, SOILS, TRACTION
from sim.vehicle import GRAVITY, Bodies
from sim.world import STEP_S, FleetState, stack

BOTH = pytest.mark.parametrize("model", [LOADER, TRUCK], ids=lambda m: m.name)


@pytest.mark.parametrize("zone", range(5), ids=[s.name for s in SOILS])
def test_steady_traction_on_the_level_is_the_rolling_resistance(zone: int) -> None:
    with bullet(plane(zone), LOADER) as world:
        last = hold_speed(world, 2.0, 7.0)[-1]
    ratio = last.torque_nm / LOADER.wheel_radius_m / last.load_n
    assert ratio[0] == pytest.approx(SOILS[zone].c_rr, rel=0.01)
    assert last.c_rr[0] == pytest.approx(SOILS[zone].c_rr)
    assert last.load_n[0] == pytest.approx(17_500 * GRAVITY, rel=1e-3)


@BOTH
@pytest.mark.parametrize("zone", [0, 3])
@pytest.mark.parametrize("uphill", [1, -1])
def test_steady_traction_on_15_degrees_adds_the_slope(model: MachineModel, zone: int, uphill: int) -> None:
    with bullet(plane(zone, uphill * GRADE_15), model) as world:
        last = hold_speed(world, 2.0, 10.0)[-1]
    ratio = last.torque_nm / model.wheel_radius_m / last.load_n
    assert ratio[0] == pytest.approx(SOILS[zone].c_rr + uphill * GRADE_15, abs=0.002)
    assert last.load_n[0] == pytest.approx(model.mass_kg * GRAVITY * math.cos(math.radians(15)), rel=1e-3)
    assert math.degrees(last.pitch_rad[0]) == pytest.approx(-15 * uphill, abs=0.4)  # tyres give way by some mm


@BOTH
@pytest.mark.parametrize("zone", [1, SAND])
def test_machine_rolls_out_by_its_resistance_and_stays(model: MachineModel, zone: int) -> None:
    turning = 1 + 4 * model.wheel_inertia_kgm2 / model.wheel_radius_m**2 / model.mass_kg
    with bullet(plane(zone), model) as world:
        hold_speed(world, 5.0, 6.0)
        start = idle(world, 1.2).speed_mps[0]  # until the engine has let go
        slower = start - idle(world, 0.5).speed_mps[0]
        assert slower / 0.5 == pytest.approx(SOILS[zone].c_rr * GRAVITY / turning, rel=0.01)
        if zone == SAND:
            end = idle(world, 4.0)
            assert abs(end.speed_mps[0]) < 1e-3
            np.testing.assert_allclose(end.force_mps2[0], [0, 0, GRAVITY], atol=0.01)


@BOTH
@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2])
@pytest.mark.parametrize("zone", [0, SAND])
def test_braked_machine_holds_on_15_degrees(model: MachineModel, yaw: float, zone: int) -> None:
    with bullet(plane(zone, GRADE_15), model, starts=[(500, 500, yaw)]) as world:
        start = world.state
        end = idle(world, 30.0, model.max_brake_n)
    creep = math.hypot(end.x_m[0] - start.x_m[0], end.y_m[0] - start.y_m[0])
    assert creep < 0.01
    assert (end.wheel_radps == 0).all()


@pytest.mark.parametrize("steer", [0.2, -0.6])
@BOTH
def test_turning_radius_is_that_of_the_articulation(model: MachineModel, steer: float) -> None:
    with bullet(plane(0), model) as world:
        states = stack(hold_speed(world, 2.0, 16.0, steer)[700:])
    x, y = states.x_m[:, 0], states.y_m[:, 0]
    # algebraic circle fit: x^2 + y^2 = 2 a x + 2 b y + c
    a, b, c = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
    kinematic = (model.front_to_joint_m + model.rear_to_joint_m * math.cos(steer)) / math.sin(abs(steer))
    assert math.sqrt(c + a * a + b * b) == pytest.approx(kinematic, rel=0.02)
    rates, speed = states.rates_radps[-1, 0], states.speed_mps[-1, 0]
    leaning = GRAVITY * math.sin(states.roll_rad[-1, 0])
    assert states.force_mps2[-1, 0, 1] - leaning == pytest.approx(speed * rates[2], rel=0.02)
    assert states.articulation_rad[-1, 0] == pytest.approx(steer, abs=1e-3)


@pytest.mark.parametrize("zone", [0, 3, SAND])
def test_wheels_slip_as_the_soil_table_says(zone: int) -> None:
    with bullet(plane(zone), LOADER) as world:
        last = hold_speed(world, 2.0, 7.0)[-1]
    use = last.torque_nm[0] / LOADER.wheel_radius_m / last.load_n[0]
    slip = np.arctanh(use / TRACTION[zone]) * TRACTION[zone] / SLIP_STIFFNESS[zone]
    measured = 1 - last.speed_mps / (last.wheel_radps[0] * LOADER.wheel_radius_m)
    np.testing.assert_allclose(measured, slip, rtol=0.02)


def test_head_on_collision_stays_finite_and_nobody_passes_through() -> None:
    with bullet(plane(1), LOADER, LOADER, starts=[(490, 500, 0), (508, 500.3, math.pi)]) as world:
        states = []
        for _ in range(800):
            push = np.clip(50e3 * (4.0 - world.state.speed_mps), -80e3, 100e3)
            states.append(world.advance(np.zeros(2), push, np.zeros(2)))
    run = stack(states)
    assert all(np.isfinite(getattr(run, f.name)).all() for f in fields(FleetState))
    gap = np.hypot(run.x_m[:, 1] - run.x_m[:, 0], run.y_m[:, 1] - run.y_m[:, 0])
    assert run.speed_mps[:, 0].max() > 2.5
    assert gap.min() > 2 * 5.25 - 0.3  # from rear axle to bucket, twice
    assert abs(run.speed_mps[-1]).max() < 0.1
    assert abs(run.roll_rad).max() < 0.2


@BOTH
def test_wheels_carry_what_the_machine_carries(model: MachineModel) -> None:
    grade = 0.1
    with bullet(plane(2, grade), model) as world:
        for payload in (0.0, model.payload_kg, 0.0):
            world.set_payload(0, payload)
            last = idle(world, 4.0, model.max_brake_n)
            assert world.mass_kg[0] == model.mass_kg + payload
            assert last.load_n[0] == pytest.approx(world.mass_kg[0] * GRAVITY / math.hypot(1, grade), rel=1e-3)
            loads = world.wheel_loads_n[0]
            shift = grade * model.centre_height_m(payload) / model.wheelbase_m
            assert loads[:2].sum() / loads.sum() == pytest.approx(model.front_share(payload) - shift, abs=0.004)


def test_true_bodies_differ_from_the_model() -> None:
    with bullet(plane(0), LOADER) as nominal:
        assert nominal.state.load_n[0] == pytest.approx(17_500 * GRAVITY, rel=1e-4)
    world = BulletWorld(plane(0), [LOADER], Bodies(np.array([18_000.0]), np.array([0.76])), np.array([[500, 500, 0.0]]))
    assert world.state.load_n[0] == pytest.approx(18_000 * GRAVITY, rel=1e-4)
    last = hold_speed(world, 2.0, 5.0)[-1]
    assert last.wheel_radps[0, 0] * 0.76 == pytest.approx(last.speed_mps[0], rel=1e-3)
    world.close()


@BOTH
def test_at_rest_the_specific_force_is_gravity_upwards(model: MachineModel) -> None:
    with bullet(plane(0), model) as world:
        np.testing.assert_allclose(world.state.force_mps2[0], [0, 0, GRAVITY], atol=1e-3)
        np.testing.assert_allclose(world.front.force_mps2[0], [0, 0, GRAVITY], atol=1e-3)
        assert abs(world.state.z_m[0]) < 1e-3
        assert abs(world.state.rates_radps).max() < 1e-4
        assert (world.state.wheel_rad == 0).all()


@pytest.mark.parametrize("yaw", [0.3, -2.0])
@BOTH
def test_grade_and_attitude_are_those_of_the_plane(model: MachineModel, yaw: float) -> None:
    with bullet(plane(0, 0.12, -0.07), model, starts=[(500, 500, yaw)]) as world:
        rest = world.state
        assert rest.grade_e[0] == pytest.approx(0.12, abs=1e-6)
        assert rest.grade_n[0] == pytest.approx(-0.07, abs=1e-6)
        assert rest.yaw_rad[0] == pytest.approx(yaw, abs=0.01)
        up = np.array([-0.12, 0.07, 1.0]) / math.sqrt(1 + 0.12**2 + 0.07**2)
        c, s = np.cos(yaw), np.sin(yaw)
        felt = rest.force_mps2[0] / GRAVITY  # the vertical as the rear frame sees it
        np.testing.assert_allclose(felt[:2], [-up[0] * c - up[1] * s, up[0] * s - up[1] * c], atol=0.01)


def test_front_frame_feels_what_the_rear_frame_and_the_joint_imply() -> None:
    with bullet(plane(0), LOADER) as world:
        states = hold_speed(world, 2.0, 4.0, 0.4)
        steering = (states[-1].articulation_rad - states[-2].articulation_rad) / STEP_S
        last, front = states[-1], world.front
        np.testing.assert_allclose(front.rates_radps[0, 2], last.rates_radps[0, 2] + steering[0], atol=2e-3)
        arm = np.array([LOADER.rear_to_joint_m, 0.0, LOADER.wheel_radius_m])
        turn, change = last.rates_radps[0], last.rates_dot_radps2[0]
        at_joint = last.force_mps2[0] + np.cross(change, arm) + np.cross(turn, np.cross(turn, arm))
        c, s = np.cos(last.articulation_rad[0]), np.sin(last.articulation_rad[0])
        expected = np.array([c * at_joint[0] + s * at_joint[1], c * at_joint[1] - s * at_joint[0], at_joint[2]])
        np.testing.assert_allclose(front.force_mps2[0], expected, atol=0.05)


def digest() -> str:
    """Fingerprint of a short drive of two machines, one of which is loaded on the way."""
    with bullet(plane(2, 0.05), LOADER, TRUCK, starts=[(500, 500, 0.3), (500, 520, 1)]) as world:
        states = []
        for i in range(200):
            if i == 100:
                world.set_payload(1, 12_000.0)
            states.append(world.advance(np.array([0.2, -0.3]), np.array([40e3, 60e3]), np.zeros(2)))
        run = stack(states)
    return hashlib.sha256(b"".join(getattr(run, f.name).tobytes() for f in fields(FleetState))).hexdigest()


def test_a_drive_repeats_bit_for_bit_here_and_in_another_process() -> None:
    first = digest()
    assert digest() == first
    code = "import sys; sys.path[:0] = sys.argv[1].split(); import test_sim_bullet as t; print(t.digest())"
    command = [sys.executable, "-c", code, " ".join(p for p in sys.path if p and " " not in p)]
    assert subprocess.run(command, capture_output=True, check=True, text=True).stdout.strip() == first


def test_closed_worlds_leave_no_client_behind() -> None:
    world = BulletWorld(plane(0), [LOADER], Bodies(np.array([17_500.0]), np.array([0.75])), np.array([[5.0, 5.0, 0.0]]))
    client = world._multi._client
    assert pybullet.isConnected(client)
    world.close()
    world.close()
    assert not pybullet.isConnected(client)
