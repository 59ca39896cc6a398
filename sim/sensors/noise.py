"""Random errors of many sensors at once: one generator per machine and sensor, and slow Gauss-Markov errors.

Each sensor draws row by row, one row per reading, so that its readings depend neither on how many are made at a time
nor on which other sensors there are. Arrays hold axes first, then readings, then sensors: (axes, r, units).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats

# The order fixes which generator a sensor gets: append only, or all seeds change their meaning.
STREAMS: tuple[str, ...] = ("body", "gps-1", "gps-2", "gps-3", "imu-1", "imu-2", "imu-3", "wheels", "torque")
STREAMS += ("articulation", "outage", "imu-4", "attitude-1", "attitude-2", "attitude-3", "attitude-4", "payload")
STREAMS += ("receivers", "driver")  # what the receivers of one machine have in common; its driver
STREAMS += ("vibration",)  # of one machine: all its IMUs shake alike
STREAMS += ("brake", "doppler-1", "doppler-2", "doppler-3")
STREAMS += ("pump", "fuel")  # of a machine whose bus speaks
SITE = 2**32 - 1  # in the place of a machine's number: what all machines of a site share
# Drawn at a time: a call for every reading would cost more than its numbers. No power of two, or the rows that all
# sensors take together would share a few lines of the cache (six times slower).
BLOCK_ROWS = 250


def generator(seed: int, machine: int, stream: str) -> np.random.Generator:
    """The generator of one sensor of a machine; the same whatever other machines and sensors there are."""
    # the key is what SeedSequence.spawn() would give the sensor's child, without spawning the others
    return _generator(seed, machine, STREAMS.index(stream))


def site_generator(seed: int) -> np.random.Generator:
    """The generator of what all machines share."""
    return _generator(seed, SITE)


def _generator(seed: int, *key: int) -> np.random.Generator:
    # SFC64: a quarter faster than numpy's default, and most of the time of a large fleet's sensors goes into draws
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=key)))


class Draws:
    """Unit normal numbers, `width` for each reading of each sensor; every sensor has its own generator."""

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
    """Exponentially correlated errors of `sigma` (axes, units); time_s: (units,). `start`: unit normals (axes, units).

    They start in their stationary distribution. Exact discretisation of b' = -b/tau + w: b+ = a b + sigma
    sqrt(1 - a^2) w with a = exp(-dt/tau) (Gazebo's plugin has dt where sqrt(dt) belongs).
    """

    def __init__(self, sigma: Floats, time_s: Floats, dt: float, start: Floats) -> None:
        self._keep = np.exp(-dt / time_s)
        self._kick = (sigma * np.sqrt(1 - self._keep**2))[:, None]
        self._error: Floats = sigma * start

    def run(self, white: Floats) -> Floats:
        """Advance by one step per row of unit white noise (axes, r, units); returns the error after each."""
        errors: Floats = white * self._kick
        for row in range(errors.shape[1]):
            errors[:, row] += self._keep * self._error
            self._error = errors[:, row]
        self._error = self._error.copy()  # so that it does not keep all the others alive
        return errors
