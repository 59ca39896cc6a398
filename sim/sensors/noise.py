"""Random errors of many sensors: one generator per machine and sensor; Gauss-Markov errors.

Every sensor draws one row per reading, so its readings depend neither on batch size nor on other sensors. Arrays are
(axes, readings, sensors), written (axes, r, units).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats

# The order determines each sensor's generator: append only, or all seeds change their meaning.
STREAMS: tuple[str, ...] = ("body", "gps-1", "gps-2", "gps-3", "imu-1", "imu-2", "imu-3", "wheels", "torque")
STREAMS += ("articulation", "outage", "imu-4", "attitude-1", "attitude-2", "attitude-3", "attitude-4", "payload")
STREAMS += ("receivers", "driver")  # shared by a machine's receivers; its driver
STREAMS += ("vibration",)  # shared by a machine's IMUs
STREAMS += ("brake", "doppler-1", "doppler-2", "doppler-3")
STREAMS += ("pump", "fuel", "retarder")  # of a machine with CAN
SITE = 2**32 - 1  # in place of a machine's number: shared by the whole site
# Drawn at a time, because a call costs more than a row. No power of two: rows of all sensors would share a few cache
# lines (six times slower).
BLOCK_ROWS = 250


def generator(seed: int, machine: int, stream: str) -> np.random.Generator:
    """Generator of one sensor, independent of other machines and sensors."""
    # the key that SeedSequence.spawn() would give
    return _generator(seed, machine, STREAMS.index(stream))


def site_generator(seed: int) -> np.random.Generator:
    """Generator of what all machines share."""
    return _generator(seed, SITE)


def _generator(seed: int, *key: int) -> np.random.Generator:
    # SFC64 is a quarter faster than numpy's default; draws dominate the sensor time of large fleets.
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))


class Draws:
    """Unit normals, `width` per reading, one generator per sensor."""

    def __init__(self, rngs: Sequence[np.random.Generator], width: int) -> None:
        self._rngs = rngs
        self._block = np.empty((len(rngs), BLOCK_ROWS, width))
        self._used = BLOCK_ROWS

    def next_rows(self, rows: int) -> Floats:
        """The next rows of all sensors, (width, rows, units)."""
        out = np.empty((self._block.shape[2], rows, len(self._rngs)))
        done = 0
        while done < rows:
            if self._used == BLOCK_ROWS:
                self._refill()
            count = min(rows - done, BLOCK_ROWS - self._used)
            out[:, done : done + count] = self._block[:, self._used : self._used + count].transpose(2, 1, 0)
            self._used += count
            done += count
        return out

    def _refill(self) -> None:
        for rng, block in zip(self._rngs, self._block, strict=True):
            rng.standard_normal(out=block)
        self._used = 0


class GaussMarkov:
    """Exponentially correlated errors, `sigma` (axes, units), time_s (units,). `start`: unit normals (axes, units).

    Stationary from the start. Exact discretisation of b' = -b/tau + w: b+ = a b + sigma sqrt(1 - a^2) w with a =
    exp(-dt/tau) (Gazebo's plugin has dt for sqrt(dt)).
    """

    def __init__(self, sigma: Floats, time_s: Floats, dt: float, start: Floats) -> None:
        self._keep = np.exp(-dt / time_s)
        self._kick = (sigma * np.sqrt(1 - self._keep**2))[:, None]
        self._error: Floats = sigma * start

    def run(self, white: Floats) -> Floats:
        """Advance one step per row of unit white noise (axes, r, units); returns the error after each."""
        errors: Floats = white * self._kick
        for row in range(errors.shape[1]):
            errors[:, row] += self._keep * self._error
            self._error = errors[:, row]
        self._error = self._error.copy()  # does not keep the other rows alive
        return errors
