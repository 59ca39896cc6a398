"""How a body sits on its tyres: the pitch that payload and longitudinal force add to that of the ground.

Axle loads of a rigid body in balance, N_f = m (g cos(slope) l_c - f h) / L and N_r = m g cos(slope) - N_f, press tyres
of stiffness k per axle by N / k; the nose rises by (N_r - N_f) / (k L). The empty machine stands level: its own pitch
is subtracted.
"""

import math

from protocol.machine.machine_config import MachineConfig
from protocol.units import GRAVITY_MPS2


def front_share(machine: MachineConfig, payload_kg: float, force_mps2: float) -> float:
    """Share of the load on the front axle [-]; 0 where the machine's data are missing.

    force_mps2: specific force ahead, gravity's share included.
    """
    if not machine.wheelbase_m:
        return 0.0
    ahead = machine.mass_kg * machine.load_centre_m + payload_kg * machine.payload_x_m  # first moments of mass
    above = machine.mass_kg * machine.cog_height_m + payload_kg * machine.payload_z_m
    lever = ahead - above * force_mps2 / _down(force_mps2)
    return lever / ((machine.mass_kg + payload_kg) * machine.wheelbase_m)


def squat_rad(machine: MachineConfig, payload_kg: float, force_mps2: float) -> float:
    """Nose-up angle [rad] against the empty machine at rest on the level; 0 where the machine's data are missing."""
    if not (machine.wheelbase_m and machine.axle_stiffness_npm):
        return 0.0
    weight_n = (machine.mass_kg + payload_kg) * _down(force_mps2)
    rear_n = weight_n * (1 - 2 * front_share(machine, payload_kg, force_mps2))  # more than on the front
    empty_n = machine.mass_kg * GRAVITY_MPS2 * (1 - 2 * front_share(machine, 0.0, 0.0))
    return (rear_n - empty_n) / (machine.axle_stiffness_npm * machine.wheelbase_m)


def _down(force_mps2: float) -> float:
    """Gravity's share across the slope that a steady machine with this force stands on [m/s2]."""
    return math.sqrt(max(GRAVITY_MPS2**2 - force_mps2**2, 1.0))
