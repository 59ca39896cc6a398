"""GNSS velocity: what a receiver makes of the Doppler shift of its signals.

It knows nothing of the slow errors of fixes: carrier frequencies suffer little from what delays the code. So it shows
the heading and the scale of the wheels at once, and lasts through errors of the fixes.
"""

import numpy as np

from agents.localisation import measurements
from agents.localisation.filters.belief import Measurement
from agents.localisation.fix import GPS_GATE_SIGMA
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import GpsVelocity

MIN_STD_MPS = 0.05  # receivers smooth their velocity, and state less than its error; if configured it may be better


def gps_velocity(reading: GpsVelocity, sensor: SensorConfig) -> Measurement:
    """Velocity of the antenna in `map`, with the variance that is configured, else with its own."""
    if "velocity" in sensor.std:
        variances = np.full(2, sensor.std["velocity"] ** 2)
    else:
        variances = np.maximum([reading.var_e_m2ps2, reading.var_n_m2ps2], MIN_STD_MPS**2)
    z, lever_m = np.array([reading.velocity_e_mps, reading.velocity_n_mps]), np.array(sensor.mount.xyz_m)
    gate = sensor.gate(GPS_GATE_SIGMA)
    return measurements.velocity(reading.stamp_ns, sensor.name, z, np.diag(variances), lever_m, gate)
