"""The GPS receiver of a base station: it stands still, and shares the site's part of the errors with all machines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from protocol.arrays import Ints
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection
from sim.sensors.gps import ReceiverErrors
from sim.sensors.noise import generator
from sim.sensors.presets import BASE_RATE_HZ, GpsNoise
from sim.state import STEP_S

RECEIVER = "gps-1"


class BaseReceiver:
    """One receiver whose antenna stands at place_m (east, north, up). number: its place behind the fleet's machines."""

    def __init__(
        self, place_m: Sequence[float], noise: GpsNoise, number: int, seed: int, projection: Projection
    ) -> None:
        self._place_m, self._projection = np.array(place_m, float)[:, None], projection
        self._every = BASE_RATE_HZ // noise.rate_hz
        self._errors = ReceiverErrors([noise], [number], [generator(seed, number, RECEIVER)], seed)
        self._outage_s, self._period_s = noise.outage_s, noise.outage_period_s
        self._phase_s = self._period_s * float(generator(seed, number, "outage").uniform())

    def sample(self, steps: Ints, stamps_ns: Ints) -> list[Reading]:
        """Fixes at those of these steps of the world (k,) that are due; errors run on while it is silent."""
        rows = np.flatnonzero(steps % self._every == 0)
        if not rows.size:
            return []
        slow, white = self._errors.run(steps[rows])
        fixes = self._projection.to_geodetic_many(*(self._place_m + (slow + white)[:, :, 0]))
        valid = (steps[rows] * STEP_S + self._phase_s) % self._period_s >= self._outage_s - 1e-9
        stated = self._errors.stated_m2[:, 0].tolist()
        columns = zip(valid.tolist(), stamps_ns[rows].tolist(), fixes.T.tolist(), strict=True)
        return [Gps(RECEIVER, stamp, *fix, *stated) for is_valid, stamp, fix in columns if is_valid]
