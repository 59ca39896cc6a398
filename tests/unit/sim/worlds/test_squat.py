"""Squat follows from what agents know of tyres and masses: the nose-up angle of a machine against the ground."""

import math

import pytest

from protocol.machine.machine_config import MachineConfig
from protocol.units import GRAVITY_MPS2
from sim.sensors.presets import load_preset
from sim.sensors.rigs import machine_config
from sim.state import stack
from sim.worlds.bullet import BulletWorld
from tests.unit.sim.planes import LOADER, TRUCK, Lane, hold_speed, idle, lanes, of_each


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


@pytest.mark.parametrize("slope_deg", [0, 15])
def test_squat_at_steady_speed_is_that_of_the_axles_loads(slope_deg: int) -> None:
    cases = [Lane(model, 1, yaw) for model in (LOADER, TRUCK) for yaw in (0.0, 0.0, math.pi, math.pi)]
    payload_kg = of_each(cases, "payload_kg") * ([0, 1] * 4)  # empty and full
    with lanes(BulletWorld, cases, math.tan(math.radians(slope_deg))) as world:
        for i, payload in enumerate(payload_kg.tolist()):
            world.set_payload(i, payload)
        idle(world, 3.0, of_each(cases, "max_brake_n"))
        last = stack(hold_speed(world, 2.0, 8.0)[-100:])
    for i, case in enumerate(cases):
        slope = math.radians(slope_deg) * math.cos(case.yaw)
        nose_up = -last.pitch_rad[:, i].mean() - slope
        force_x = GRAVITY_MPS2 * math.sin(slope) + float(last.accel_mps2[:, i].mean())
        machine = machine_config("a", case.model, load_preset("dgps"), (), (), ())
        expected = nose_up_rad(machine, payload_kg[i], force_x, GRAVITY_MPS2 * math.cos(slope))
        assert nose_up == pytest.approx(expected, abs=0.0005)
        if payload_kg[i] or slope_deg:
            assert abs(nose_up) > 0.002  # else there would be nothing to see
