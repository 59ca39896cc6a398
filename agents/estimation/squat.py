"""How a body sits on its tyres: the pitch that payload and longitudinal force add to that of the ground.

Axle loads of a rigid body in balance, N_f = m (g cos(slope) l_c - f h) / L and N_r = m g cos(slope) - N_f, press tyres
of stiffness k per axle by N / k; the nose rises by (N_r - N_f) / (k L). A machine stands level when empty, so that
much is taken off.
"""

from __future__ import annotations

import math

from agents.physics import GRAVITY_MPS2
from protocol.machine import MachineConfig


def squat_rad(machine: MachineConfig, payload_kg: float, force_mps2: float) -> float:
    """Nose-up angle [rad] against the empty machine at rest on level ground; 0 where the machine's data are not known.

    force_mps2: specific force ahead, gravity's share included.
    """
    if not (machine.wheelbase_m and machine.axle_stiffness_npm):
        return 0.0
    wheelbase = machine.wheelbase_m
    ahead = machine.mass_kg * machine.load_centre_m + payload_kg * machine.payload_x_m  # first moments of mass
    above = machine.mass_kg * machine.cog_height_m + payload_kg * machine.payload_z_m
    down = math.sqrt(max(GRAVITY_MPS2**2 - force_mps2**2, 0.0))  # gravity's share across the slope
    rear_n = down * (machine.mass_kg + payload_kg - 2 * ahead / wheelbase) + 2 * force_mps2 * above / wheelbase
    empty_n = GRAVITY_MPS2 * machine.mass_kg * (1 - 2 * machine.load_centre_m / wheelbase)
    return (rear_n - empty_n) / (machine.axle_stiffness_npm * wheelbase)
