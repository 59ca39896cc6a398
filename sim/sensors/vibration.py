"""How the bodies of machines shake: broad-band, with the lugs of their wheels, and with their engine.

A body that shakes goes nowhere: its velocity and its angle stay small, so that vibration averages out faster than white
noise does. On a Clearpath Husky the sideways force has a standard deviation of 0.35 m/s2 over 1/30 s, 0.083 over 1/6 s
and 0.031 over half a second; white noise would leave 0.16 and 0.09. So the broad-band part is the derivative of
a Gauss-Markov velocity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats, Ints
from sim.sensors.noise import Draws, GaussMarkov, generator
from sim.sensors.presets import ImuNoise
from sim.state import STEP_S

SHAKE_S = 0.03  # correlation time of the velocity; assumed, the Husky's force falls off from there on
LUGS = 20  # of a wheel's tread: 17 Hz at 4 m/s on a wheel of 0.75 m; assumed
ENGINE_HZ = 30.0  # 1800 revolutions a minute; assumed


class Vibration:
    """Rates [rad/s] and forces [m/s2] of shaking bodies, three axes each, in the axes of the frame that shakes.

    noises, machines: of each IMU (units,). Those of one machine shake alike, whatever frame carries them.
    """

    def __init__(self, noises: Sequence[ImuNoise], machines: Sequence[int], seed: int) -> None:
        rngs = [generator(seed, machine, "vibration") for machine in machines]
        rates = np.radians([noise.degps_per_mps2 for noise in noises])
        per_mps2 = np.array([rates] * 3 + [np.ones_like(rates)] * 3)[:, None]  # (6, 1, units)
        parts = np.array([(noise.shake_mps2, noise.wheel_mps2, noise.engine_mps2) for noise in noises]).T
        self._shake, self._wheel, self._engine = (per_mps2 * part for part in parts)
        self._full_mps = np.array([noise.vibration_speed_mps for noise in noises])
        start = np.stack([rng.standard_normal(12) for rng in rngs], axis=-1)
        self._phases_rad = 2 * np.pi * start[:6, None]  # each axis has its own
        time_s, dt_s = np.full(len(noises), SHAKE_S), 1 / noises[0].rate_hz
        self._moved = GaussMarkov(np.ones((6, len(noises))), time_s, dt_s, start[6:])
        self._last = start[6:, None]
        self._unit = np.sqrt(2 * (1 - np.exp(-dt_s / SHAKE_S)))  # standard deviation of a step of it
        self._draws = Draws(rngs, 6)

    def run(self, steps: Ints, speed_mps: Floats, wheel_rad: Floats) -> Floats:
        """The vibration (6, r, units) at the next steps (r,). speed_mps, wheel_rad: (r, units)."""
        moved = np.concatenate([self._last, self._moved.run(self._draws.next_rows(len(steps)))], axis=1)
        self._last = moved[:, -1:]
        lugs = np.sin(LUGS * wheel_rad + self._phases_rad)
        engine = np.sin(2 * np.pi * ENGINE_HZ * STEP_S * steps[:, None] + self._phases_rad)
        driving = np.minimum(np.abs(speed_mps) / self._full_mps, 1.0)
        shaking = self._shake * np.diff(moved, axis=1) / self._unit + np.sqrt(2) * self._wheel * lugs
        vibration: Floats = driving * shaking + np.sqrt(2) * self._engine * engine
        return vibration


def shakes(noise: ImuNoise) -> bool:
    """Whether an IMU of these errors sits on a body that shakes."""
    return max(noise.shake_mps2, noise.wheel_mps2, noise.engine_mps2) > 0
