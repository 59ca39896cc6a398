"""Fixes that are withheld from the filter and compared with its poses: an honest error on real logs.

A receiver that is away has no velocity either, so that is withheld with the fixes.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.pipeline import PoseSource
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, GpsVelocity, Reading
from protocol.site.site_config import Projection, SiteConfig

SETTLE_S = 40.0  # fixes are judged from so long after the first reading on: by then a machine that drives is aligned


@dataclass(frozen=True)
class HoldoutConfig:
    """Withhold GPS for off_s of every period_s."""

    period_s: float = 10.0
    off_s: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.off_s < self.period_s:
            raise ValueError("off_s must lie between 0 and period_s")


class Holdout:
    """Splits off fixes before the pipeline sees them, and compares them with its poses afterwards."""

    def __init__(
        self, site: SiteConfig, machine: MachineConfig, config: HoldoutConfig, settle_s: float = SETTLE_S
    ) -> None:
        self._config, self._settle_s = config, settle_s
        self._projection = Projection(site)
        self._sensors = {s.name: s for s in machine.sensors}
        self._first_ns = 0
        self._waiting: deque[Gps] = deque()
        self._errors_m: list[float] = []

    def split(self, readings: Sequence[Reading]) -> list[Reading]:
        """Return what the pipeline may see."""
        return [r for r in readings if not self._is_withheld(r)]

    def compare(self, pipeline: PoseSource) -> None:
        """Compare withheld fixes with the poses that are known by now."""
        pose = pipeline.pose
        while pose and self._waiting and self._true_ns(self._waiting[0]) <= pose.stamp_ns:
            fix = self._waiting.popleft()
            if (at := pipeline.pose_at(self._true_ns(fix))) and self._seconds(fix) >= self._settle_s:
                x, y, _ = self._projection.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
                lever = self._sensors[fix.sensor].mount.xyz_m
                c, s = math.cos(at.heading_rad), math.sin(at.heading_rad)
                dx = at.x_m + c * lever[0] - s * lever[1] - x
                dy = at.y_m + s * lever[0] + c * lever[1] - y
                self._errors_m.append(math.hypot(dx, dy))

    def report(self) -> dict[str, float | int | None]:
        """How many fixes were judged, and the error against them [m]."""
        if not self._errors_m:
            return {"fixes": 0, "rms_m": None, "median_m": None, "max_m": None}
        errors = np.array(self._errors_m)
        rms = float(np.sqrt((errors**2).mean()))
        return {
            "fixes": len(errors),
            "rms_m": round(rms, 3),
            "median_m": round(float(np.median(errors)), 3),
            "max_m": round(float(errors.max()), 3),
        }

    def _is_withheld(self, reading: Reading) -> bool:
        self._first_ns = self._first_ns or reading.stamp_ns
        if not isinstance(reading, Gps | GpsVelocity) or reading.sensor not in self._sensors:
            return False
        if self._seconds(reading) % self._config.period_s >= self._config.off_s:
            return False
        if isinstance(reading, Gps):
            self._waiting.append(reading)
        return True

    def _true_ns(self, fix: Gps) -> int:
        return self._sensors[fix.sensor].true_ns(fix.stamp_ns)

    def _seconds(self, reading: Reading) -> float:
        return (reading.stamp_ns - self._first_ns) * 1e-9
