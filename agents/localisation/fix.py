"""A GPS fix, in `map` and in the dead-reckoned frame."""

import math
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, SensorConfig


@dataclass(frozen=True)
class Fix:
    """A fix in `map`, (2,) each [m, m2], with the dead-reckoned pose."""

    stamp_ns: int
    sensor: SensorConfig
    position_m: Floats
    variance_m2: Floats
    reckoned: DeadReckonedPose

    @property
    def is_absolute(self) -> bool:
        """Whether it needs no anchor."""
        return self.sensor.mode == ABSOLUTE

    @property
    def lever_m(self) -> Floats:
        """Antenna mount (3,)."""
        return np.array(self.sensor.mount.xyz_m)

    @property
    def reckoned_antenna_m(self) -> tuple[float, float]:
        """The antenna in the dead-reckoned frame."""
        (ahead, left, _), reckoned = self.sensor.mount.xyz_m, self.reckoned
        c, s = math.cos(reckoned.angle_rad), math.sin(reckoned.angle_rad)
        return reckoned.x_m + c * ahead - s * left, reckoned.y_m + s * ahead + c * left
