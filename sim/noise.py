"""Random errors of sensors: slow Gauss-Markov errors, exact at any time step, and one generator per machine and sensor.

Draws are made row by row, one row per reading, so that readings do not depend on how many are made at a time.
"""

from __future__ import annotations

import math

import numpy as np

from protocol.arrays import Floats

# The order fixes which generator a sensor gets: append only, or all seeds change their meaning.
STREAMS = ("body", "gps-1", "gps-2", "gps-3", "imu-1", "imu-2", "imu-3", "wheels", "torque", "articulation", "outage")


def generators(seed: int, machine: int) -> dict[str, np.random.Generator]:
    """One generator per sensor of a machine; the same whatever other machines and sensors there are."""
    # the key is what SeedSequence.spawn() would give the machine's child, without spawning the others
    root = np.random.SeedSequence(seed, spawn_key=(machine,))
    return {name: np.random.default_rng(child) for name, child in zip(STREAMS, root.spawn(len(STREAMS)), strict=True)}


class GaussMarkov:
    """Exponentially correlated errors of `sigma` (k,), started in their stationary distribution.

    Exact discretisation of b' = -b/tau + w: b+ = a b + sigma sqrt(1 - a^2) w with a = exp(-dt/tau) (EVIDENCE: Gazebo's
    plugin puts dt where sqrt(dt) belongs).
    """

    def __init__(self, sigma: Floats, time_s: float, dt: float, rng: np.random.Generator) -> None:
        self._keep = math.exp(-dt / time_s)
        self._kick = sigma * math.sqrt(1 - self._keep**2)
        self._error: Floats = sigma * rng.standard_normal(len(sigma))

    def run(self, white: Floats) -> Floats:
        """Advance by one step per row of unit white noise (n, k); returns the error after each (n, k)."""
        errors = white * self._kick
        for row in errors:
            row += self._keep * self._error
            self._error = row
        return errors
