"""The true state of all machines at one instant: what worlds compute, and sensors, drivers and pictures read."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from protocol.arrays import Floats

STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class FleetState:
    """True state of n machines at one instant; every array has the shape (n,), or (n, k) where k is given.

    Position of `base_link` in `map`, attitude as yaw, pitch (nose down) and roll, speed along the ground, negative in
    reverse. rates, rates_dot: angular rate and acceleration in `base_link` (3). force: specific force at `base_link`,
    in its axes, gravity included (3). articulation: angle of the front frame, its rate and acceleration; the frames are
    rigid, so these carry rates and force over to the front one. wheel_*: of the rear axle, left and right (2). torque:
    at all wheels together. load: of all wheels on the ground. mass: with the payload. c_rr, grade: of the ground under
    the wheels, weighted by their loads, and as the plane through them.
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
    """Join k states into one with arrays (k, n, ...)."""
    return FleetState(*(np.array([getattr(s, f.name) for s in states]) for f in fields(FleetState)))
