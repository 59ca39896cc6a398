"""Vibration of machine bodies: broad-band, from wheel lugs, from the engine.

A vibrating body goes nowhere, so vibration averages out faster than white noise. Sideways force of a Clearpath Husky:
0.35 m/s2 over 1/30 s, 0.083 over 1/6 s, 0.031 over 0.5 s; white noise would leave 0.16 and 0.09. So the broad-band part
is the derivative of a Gauss-Markov velocity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats, Ints
from sim.sensors.noise import Draws, GaussMarkov, generator
from sim.sensors.presets import ImuNoise
from sim.state import STEP_S

SHAKE_S = 0.03  # correlation time of the velocity; assumed: the Husky's force falls off from there
LUGS = 20  # of a wheel's tread: 17 Hz at 4 m/s, radius 0.75 m; assumed
ENGINE_HZ = 30.0  # 1800 rev/min; assumed


class Vibration:
    """Vibration rates [rad/s] and forces [m/s2], three axes each, in the vibrating frame.

    noises, machines: per IMU (units,). All IMUs of a machine vibrate alike, on either frame.
    """

    def __init__(self, noises: Sequence[ImuNoise], machines: Sequence[int], seed: int) -> None:
        rngs = [generator(seed, machine, "vibration") for machine in machines]
        rates = np.radians([noise.degps_per_mps2 for noise in noises])
        per_mps2 = np.array([rates] * 3 + [np.ones_like(rates)] * 3)[:, None]  # (6, 1, units)
        parts = np.array([(noise.shake_mps2, noise.wheel_mps2, noise.engine_mps2) for noise in noises]).T
        self._shake, self._wheel, self._engine = (per_mps2 * part for part in parts)
        self._full_mps = np.array([noise.vibration_speed_mps for noise in noises])
        start = np.stack([rng.standard_normal(12) for rng in rngs], axis=-1)
        self._phases_rad = 2 * np.pi * start[:6, None]  # one per axis
        time_s, dt_s = np.full(len(noises), SHAKE_S), 1 / noises[0].rate_hz
        self._moved = GaussMarkov(np.ones((6, len(noises))), time_s, dt_s, start[6:])
        self._last = start[6:, None]
        self._unit = np.sqrt(2 * (1 - np.exp(-dt_s / SHAKE_S)))  # standard deviation of one step
        self._draws = Draws(rngs, 6)

    def run(self, steps: Ints, speed_mps: Floats, wheel_rad: Floats) -> Floats:
        """Vibration (6, r, units) at the next steps (r,). speed_mps, wheel_rad: (r, units)."""
        moved = np.concatenate([self._last, self._moved.run(self._draws.next_rows(len(steps)))], axis=1)
        self._last = moved[:, -1:]
        lugs = np.sin(LUGS * wheel_rad + self._phases_rad)
        engine = np.sin(2 * np.pi * ENGINE_HZ * STEP_S * steps[:, None] + self._phases_rad)
        driving = np.minimum(np.abs(speed_mps) / self._full_mps, 1.0)
        shaking = self._shake * np.diff(moved, axis=1) / self._unit + np.sqrt(2) * self._wheel * lugs
        vibration: Floats = driving * shaking + np.sqrt(2) * self._engine * engine
        return vibration


def shakes(noise: ImuNoise) -> bool:
    """Whether the IMU's body vibrates."""
    return max(noise.shake_mps2, noise.wheel_mps2, noise.engine_mps2) > 0
