"""Squat follows from what agents know of tyres and masses: the nose-up angle of a machine against the ground."""

import math

import numpy as np
import pytest

from protocol.machine.machine_config import MachineConfig
from protocol.units import GRAVITY_MPS2
from sim.machines.model import MachineModel
from sim.sensors.presets import load_preset
from sim.sensors.rigs import machine_config
from sim.worlds.bullet import BulletWorld
from tests.unit.sim.bullet_worlds import BOTH, hold_speed, idle, placed, plane


def load_difference_n(machine: MachineConfig, payload_kg: float, force_x_mps2: float, force_z_mps2: float) -> float:
    """Load of the rear axle less that of the front one; force: specific, along and across the ground."""
    mass_kg = machine.mass_kg + payload_kg
    moment_x = machine.mass_kg * machine.load_centre_m + payload_kg * machine.payload_x_m
    moment_z = machine.mass_kg * machine.cog_height_m + payload_kg * machine.payload_z_m
    front_n = (force_z_mps2 * moment_x - force_x_mps2 * moment_z) / machine.wheelbase_m
    return mass_kg * force_z_mps2 - 2 * front_n


def nose_up_rad(machine: MachineConfig, payload_kg: float, force_x_mps2: float, force_z_mps2: float) -> float:
    """Nose-up angle of the frame against the ground, 0 for the empty machine that stands level."""
    more_n = load_difference_n(machine, payload_kg, force_x_mps2, force_z_mps2)
    more_n -= load_difference_n(machine, 0.0, 0.0, GRAVITY_MPS2)
    return more_n / (machine.axle_stiffness_npm * machine.wheelbase_m)


@BOTH
@pytest.mark.parametrize("slope_deg", [0, 15, -15])
@pytest.mark.parametrize("full", [False, True], ids=["empty", "full"])
def test_squat_at_steady_speed_is_that_of_the_axles_loads(model: MachineModel, slope_deg: int, *, full: bool) -> None:
    machine = machine_config("a", model, load_preset("dgps"), (), (), ())
    slope, payload_kg = math.radians(slope_deg), model.payload_kg * full
    with placed(BulletWorld, plane(1, math.tan(slope)), model) as world:
        world.set_payload(0, payload_kg)
        idle(world, 3.0, model.max_brake_n)
        last = hold_speed(world, 2.0, 8.0)[-100:]
    nose_up = -np.mean([state.pitch_rad[0] for state in last]) - slope
    force_x = GRAVITY_MPS2 * math.sin(slope) + float(np.mean([state.accel_mps2[0] for state in last]))
    assert nose_up == pytest.approx(
        nose_up_rad(machine, payload_kg, force_x, GRAVITY_MPS2 * math.cos(slope)), abs=0.0005
    )
    if full or slope_deg:
        assert abs(nose_up) > 0.002  # else there would be nothing to tell
