import math
from itertools import pairwise

import numpy as np
import pytest

from protocol.machine.machine_config import Mount
from protocol.units import GRAVITY_MPS2
from sim.machines.model import MachineModel
from sim.state import STEP_S, FleetState, stack
from sim.terrain.terrain import C_RR, Terrain
from sim.worlds.fast import FastWorld
from tests.unit.sim.planes import BOTH, GRADE_15, LOADER, TRUCK, cruise, idle, placed, plane


def wheels(model: MachineModel, state: FleetState) -> np.ndarray:
    """Wheel places (4, 2) of the only machine: front left, front right, rear left, rear right."""
    yaw, front = state.yaw_rad[0], state.yaw_rad[0] + state.articulation_rad[0]
    rear_axle = np.array([state.x_m[0], state.y_m[0]])
    ahead, ahead_front = (np.array([math.cos(a), math.sin(a)]) for a in (yaw, front))
    front_axle = rear_axle + model.rear_to_joint_m * ahead + model.front_to_joint_m * ahead_front
    half = 0.5 * model.track_m
    left, left_front = (half * np.array([-math.sin(a), math.cos(a)]) for a in (yaw, front))
    return np.array([front_axle + left_front, front_axle - left_front, rear_axle + left, rear_axle - left])


def sunk_m(model: MachineModel, slope_rad: float) -> tuple[float, float]:
    """Extra tyre deflection, front and rear, of a parked empty machine on a slope."""
    weight_n, level = model.mass_kg * GRAVITY_MPS2, model.front_share()
    uphill = model.centre_height_m() / model.wheelbase_m * math.sin(slope_rad)
    front_n, rear_n = (
        weight_n * (share * math.cos(slope_rad) + to_rear - share)
        for share, to_rear in ((level, -uphill), (1 - level, uphill))
    )
    return front_n / (2 * model.tyre_stiffness_npm), rear_n / (2 * model.tyre_stiffness_npm)


@BOTH
def test_neither_axle_slips_sideways_while_the_joint_turns(model: MachineModel) -> None:
    with placed(FastWorld, plane(0), model, starts=[(500, 500, 0.4)]) as world:
        cruise(world, 2.0, 4.0)
        states = [world.advance(np.array([0.5]), np.array([3e3]), np.zeros(1)) for _ in range(150)]
    for old, new in pairwise(states):
        moved = (wheels(model, new) - wheels(model, old)) / STEP_S
        for axle, yaw in ((slice(0, 2), new.yaw_rad + new.articulation_rad), (slice(2, 4), new.yaw_rad)):
            mean = moved[axle].mean(axis=0)
            turned_in_a_step = 0.005
            assert abs(mean @ [-math.sin(yaw[0]), math.cos(yaw[0])]) < turned_in_a_step * np.hypot(*mean) + 1e-3


@BOTH
def test_the_estimators_equation_holds_at_every_instant(model: MachineModel) -> None:
    # F/m - (f_x - g squat) - (lambda-1) dv = c g cos(theta): the accelerometer contains gravity's share
    slope = math.atan(0.1 * math.cos(0.4) + 0.05 * math.sin(0.4))
    rolling = 4 * model.wheel_inertia_kgm2 / model.wheel_radius_m**2
    with placed(FastWorld, plane(3, 0.1, 0.05), model, starts=[(500, 500, 0.4)]) as world:
        for state in cruise(world, 3.0, 6.0)[300:]:
            force = state.torque_nm[0] / model.wheel_radius_m - rolling * state.accel_mps2[0]
            squat = -state.pitch_rad[0] - slope
            nodding = model.centre_height_m() * state.rates_dot_radps2[0, 1]  # of the centre against `base_link`
            left = force / model.mass_kg - state.force_mps2[0, 0] - nodding + GRAVITY_MPS2 * squat
            assert left == pytest.approx(0.06 * state.load_n[0] / model.mass_kg, abs=1e-3)


@BOTH
@pytest.mark.parametrize("steer", [0.0, 0.5])
def test_machines_rest_on_three_points_of_rough_ground(model: MachineModel, steer: float) -> None:
    rng = np.random.default_rng(5)
    terrain = Terrain(rng.normal(0, 0.1, (60, 60)), 0.5, rng.integers(0, 5, (30, 30)), 1.0)
    with placed(FastWorld, terrain, model, starts=[(12, 13, 0.8)]) as world:
        for _ in range(400):
            state = world.advance(np.array([steer]), np.zeros(1), np.full(1, 1e6))
    places = wheels(model, state)
    points = np.column_stack([places, terrain.height(*places.T)])
    front, rear = points[:2].mean(axis=0), points[2:].mean(axis=0)
    axle = points[0] - points[1] if model.rolls_with_front else points[2] - points[3]
    up = np.cross(front - rear, axle)
    c, s = math.cos(state.yaw_rad[0]), math.sin(state.yaw_rad[0])
    seen = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ up / np.linalg.norm(up)
    pitch, roll = state.pitch_rad[0], state.roll_rad[0]
    slope = -math.atan(seen[0] / seen[2])
    sunk = sunk_m(model, slope)  # tyres yield where the slope puts the weight
    squat = (sunk[1] - sunk[0]) / model.wheelbase_m
    np.testing.assert_allclose([pitch, math.sin(roll)], [-slope - squat, -seen[1]], atol=1e-6)
    assert state.z_m[0] == pytest.approx(rear[2] - sunk[1], abs=2e-5)

    left = points[0] - points[1] + points[2] - points[3]
    through_all = np.cross(front - rear, left)
    gradient = -through_all[:2] / through_all[2]
    np.testing.assert_allclose([state.grade_e[0], state.grade_n[0]], gradient, atol=1e-9)
    zones = terrain.zone(*places.T)
    assert C_RR[zones].min() <= state.c_rr[0] <= C_RR[zones].max()


def test_brakes_hold_without_any_creep_and_slide_beyond_the_grip() -> None:
    with placed(FastWorld, plane(0, GRADE_15), TRUCK, starts=[(500, 500, 0.7)]) as world:
        start = world.state
        held = idle(world, 5.0, TRUCK.max_brake_n)
        assert (held.x_m, held.y_m, held.speed_mps) == (start.x_m, start.y_m, 0.0)
        assert held.torque_nm[0] > 0  # prevents rolling back
        assert idle(world, 1.0, 1e3).speed_mps[0] < -0.5
    with placed(FastWorld, plane(3, 0.6), TRUCK) as world:
        assert idle(world, 1.0, TRUCK.max_brake_n).speed_mps[0] < -0.5


def test_machines_do_not_feel_each_other() -> None:
    together = [(500, 500, 0.3), (500, 520, 1.0)]
    steer, drive = np.array([0.2, -0.3]), np.array([40e3, 60e3])
    with placed(FastWorld, plane(2, 0.05), LOADER, TRUCK, starts=together) as both:
        joint = stack([both.advance(steer, drive, np.zeros(2)) for _ in range(200)])
    for i, model in enumerate((LOADER, TRUCK)):
        with placed(FastWorld, plane(2, 0.05), model, starts=[together[i]]) as alone:
            own = stack([alone.advance(steer[i : i + 1], drive[i : i + 1], np.zeros(1)) for _ in range(200)])
        np.testing.assert_array_equal(joint.x_m[:, i], own.x_m[:, 0])
        np.testing.assert_array_equal(joint.force_mps2[:, i], own.force_mps2[:, 0])


def test_rates_are_those_of_the_turning_frame() -> None:
    """Angular rate in `base_link` against the change of the rotation matrix."""
    with placed(FastWorld, plane(0, 0.12, -0.07), LOADER) as world:
        states = cruise(world, 2.0, 6.0, 0.4)[-2:]
    matrices = []
    for state in states:
        angles = np.degrees([state.roll_rad[0], state.pitch_rad[0], state.yaw_rad[0]])
        matrices.append(Mount(rpy_deg=tuple(angles)).frame_from_sensor())
    turn = matrices[0].T @ (matrices[1] - matrices[0]) / STEP_S
    expected = [turn[2, 1], turn[0, 2], turn[1, 0]]
    assert abs(expected[2]) > 0.1
    np.testing.assert_allclose(states[1].rates_radps[0], expected, atol=2e-3)
