import math
from dataclasses import dataclass, fields

import numpy as np
import pytest

from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2
from sim.machines.model import MachineModel
from sim.state import STEP_S, FleetState, stack
from sim.worlds.bullet import BulletWorld
from tests.unit.sim.planes import BOTH, LOADER, TRUCK, Lane, idle, lanes, placed, plane


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
    assert gap.min() > 2 * 5.25 - 0.3  # from rear axle to bucket, twice
    assert abs(run.speed_mps[-1]).max() < 0.1
    assert abs(run.roll_rad).max() < 0.2


@pytest.mark.nightly
@pytest.mark.slow
def test_wheels_carry_what_the_machine_carries() -> None:
    grade, models = 0.1, (LOADER, TRUCK)
    with lanes(BulletWorld, [Lane(model, 2) for model in models], grade) as world:
        for share in (0.0, 1.0, 0.0):
            for machine, model in enumerate(models):
                world.set_payload(machine, share * model.payload_kg)
            idle(world, 4.0, [model.max_brake_n for model in models])
            for loads, model in zip(world._wheel_load_n, models, strict=True):
                payload = share * model.payload_kg
                weight_n = (model.mass_kg + payload) * GRAVITY_MPS2
                assert loads.sum() == pytest.approx(weight_n / math.hypot(1, grade), rel=1e-3)
                shift = grade * model.centre_height_m(payload) / model.wheelbase_m
                assert loads[:2].sum() / loads.sum() == pytest.approx(model.front_share(payload) - shift, abs=0.004)


@dataclass(frozen=True)
class Front:
    """Angular rate of the front link, and velocity and rotation of its origin, in `map`."""

    rate: Floats
    velocity: Floats
    rotation: Floats


def front_link(world: BulletWorld) -> Front:
    frames = world._scene.frames
    rotation, rate = frames.rotation[0, 1], frames.rate_radps[0, 1]
    arm = rotation @ -world._multi.centres_m[0, 1]
    return Front(rate, frames.velocity_mps[0, 1] + np.cross(rate, arm), rotation)


@pytest.mark.nightly
@pytest.mark.parametrize("ahead", [150, 370])
@BOTH
def test_front_frame_moves_as_the_rear_frame_and_the_joint_imply(model: MachineModel, ahead: int) -> None:
    zero = np.zeros(1)
    with placed(BulletWorld, plane(1, 0.04), model) as world:
        for i in range(ahead):  # at the end it steers, to the left and back again
            old = front_link(world)
            steer = np.array([0.4 * (100 < i < 350)])
            state = world.advance(steer, np.array([0.1 * model.mass_kg * GRAVITY_MPS2]), zero)
        new = front_link(world)
    c, s = math.cos(state.articulation_rad[0]), math.sin(state.articulation_rad[0])
    front_from_base = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    up = np.array([0, 0, 1.0])
    rates, rates_dot = state.rates_radps[0], state.rates_dot_radps2[0]
    own_rates = front_from_base @ (rates + state.articulation_radps[0] * up)
    arm = np.array([model.rear_to_joint_m, 0, model.wheel_radius_m])
    force = front_from_base @ (state.force_mps2[0] + np.cross(rates_dot, arm) + np.cross(rates, np.cross(rates, arm)))

    measured = new.rotation.T @ ((new.velocity - old.velocity) / STEP_S + [0, 0, GRAVITY_MPS2])
    turn, old_turn = new.rotation.T @ new.rate, old.rotation.T @ old.rate
    assert abs(state.articulation_radps[0]) > 0.1
    held = slice(0 if model.rolls_with_front else 1, 3)  # the truck's front frame rolls by itself
    np.testing.assert_allclose(turn[held], own_rates[held], atol=0.002)
    np.testing.assert_allclose(measured, force, atol=0.05)
    dot = front_from_base @ (
        rates_dot + state.articulation_radps2[0] * up + np.cross(rates, state.articulation_radps[0] * up)
    )
    np.testing.assert_allclose(((turn - old_turn) / STEP_S)[held], dot[held], atol=0.05)
