"""Squat, the nose-up angle of a machine against the ground, follows from what agents know of tyres and masses."""

import math

import pytest

from agents.estimation.balance import squat_rad
from protocol.units import GRAVITY_MPS2
from sim.sensors.presets import load_preset
from sim.sensors.rigs import machine_config
from sim.state import stack
from tests.unit.sim.planes import EACH, LOADER, TRUCK, Lane, cruise, idle, lanes, of_each


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
            assert abs(nose_up) > 0.002  # else there would be nothing to see
