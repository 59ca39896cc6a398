"""Wheel slip: driven wheels turn further than the machine moves, by a share that grows with traction.

    slip = traction (s0 + s1 rolling)        machine speed = wheel speed (1 - slip sign(speed))

traction: drive force over weight, signed ahead. rolling: the part of it that neither climbs nor accelerates, which an
accelerometer ahead measures together. s0, s1: `slip` and `slip_soft` of the tyres; soft ground resists, and gives way.
"""

import math

from protocol.units import GRAVITY_MPS2

ROLLING_S = 0.5  # time constant of the low-pass on the rolling resistance


def rolling_resistance(before: float, traction: float, force_ahead_mps2: float, dt_s: float) -> float:
    """Rolling resistance over weight [-], low-passed from the one before; force_ahead_mps2: of the accelerometer."""
    rolling = abs(traction - force_ahead_mps2 / GRAVITY_MPS2)
    return before + min(dt_s / ROLLING_S, 1.0) * (rolling - before)


def machine_speed(wheel_mps: float, traction: float, slip_per_traction: float) -> float:
    """Speed of a machine [m/s] from that of its wheels."""
    return wheel_mps * (1 - traction * slip_per_traction * math.copysign(1.0, wheel_mps))
