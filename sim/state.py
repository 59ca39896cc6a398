"""True state of all machines: from worlds, for sensors, drivers and pictures."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from protocol.arrays import Floats

STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class FleetState:
    """True state of n machines; arrays (n,), or (n, k) where k is given.

    Position of `base_link` in `map`; yaw, pitch (nose down), roll; speed along the ground, negative in reverse. rates,
    rates_dot (3): angular rate and acceleration in `base_link`. force (3): specific force at `base_link` in its axes,
    gravity included. articulation: of the front frame; angle, rate, acceleration carry rates and force over to it.
    wheel_* (2): rear left and right. torque, load: of all wheels. mass: with payload. c_rr: under the wheels, by load.
    grade: of the plane through the wheels.
    """

    x_m: Floats
    y_m: Floats
    z_m: Floats
    yaw_rad: Floats
    pitch_rad: Floats
    roll_rad: Floats
    speed_mps: Floats
    accel_mps2: Floats
    pitch_radps: Floats
    roll_radps: Floats
    rates_radps: Floats
    rates_dot_radps2: Floats
    force_mps2: Floats
    articulation_rad: Floats
    articulation_radps: Floats
    articulation_radps2: Floats
    drive_n: Floats
    torque_nm: Floats
    load_n: Floats
    mass_kg: Floats
    payload_kg: Floats
    wheel_radps: Floats
    wheel_rad: Floats
    c_rr: Floats
    grade_e: Floats
    grade_n: Floats


def stack(states: list[FleetState]) -> FleetState:
    """Stack k states into arrays (k, n, ...)."""
    return FleetState(*(np.array([getattr(s, f.name) for s in states]) for f in fields(FleetState)))
