"""Fixes withheld from the filter and compared with its poses: an honest error on real logs.

Velocities are withheld too, as an absent receiver has none. A fix is compared with the position, and with the position
plus the receiver's estimated slow error: the first alone would punish a filter that does not follow slow errors.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from agents.pipeline import PoseSource
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, GpsVelocity, Reading
from protocol.site.site_config import Projection, SiteConfig

FIGURES = ("rms_m", "median_m", "max_m", "end_m", "expected_rms_m", "expected_median_m")
NOTHING: dict[str, float | int | None] = {"fixes": 0, **dict.fromkeys(FIGURES)}  # report without judged fixes
SETTLE_S = 40.0  # time before fixes are judged: a driving machine is aligned by then


class Schedule(Protocol):
    """When GPS is withheld."""

    def withholds(self, seconds: float) -> bool:
        """Whether it is, `seconds` after the first reading."""


@dataclass(frozen=True)
class HoldoutConfig:
    """Withhold GPS for off_s of every period_s."""

    period_s: float = 10.0
    off_s: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.off_s < self.period_s:
            raise ValueError("off_s must lie between 0 and period_s")

    def withholds(self, seconds: float) -> bool:
        """Whether GPS is withheld, `seconds` after the first reading."""
        return seconds % self.period_s < self.off_s


class Holdout:
    """Withholds fixes from the pipeline, and compares them with its poses."""

    def __init__(
        self, site: SiteConfig, machine: MachineConfig, schedule: Schedule, settle_s: float = SETTLE_S
    ) -> None:
        self._schedule, self._settle_s = schedule, settle_s
        self._projection = Projection(site)
        self._sensors = {s.name: s for s in machine.sensors}
        self._first_ns = 0
        self._waiting: deque[tuple[Gps, int]] = deque()  # with number of the outage
        self._errors_m: list[tuple[float, float]] = []  # against the position, and the expected fix
        self._last_m: dict[int, float] = {}  # of each outage's last fix
        self._outage, self._is_dark = 0, False

    def split(self, readings: Sequence[Reading]) -> list[Reading]:
        """The readings that the pipeline may see."""
        return [r for r in readings if not self._is_withheld(r)]

    def compare(self, pipeline: PoseSource) -> None:
        """Compare withheld fixes with the poses known so far."""
        pose = pipeline.pose
        while pose and self._waiting and self._true_ns(self._waiting[0][0]) <= pose.stamp_ns:
            fix, outage = self._waiting.popleft()
            if (at := pipeline.pose_at(self._true_ns(fix))) and self._seconds(fix) >= self._settle_s:
                x, y, _ = self._projection.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
                lever = self._sensors[fix.sensor].mount.xyz_m
                c, s = math.cos(at.heading_rad), math.sin(at.heading_rad)
                dx = at.x_m + c * lever[0] - s * lever[1] - x
                dy = at.y_m + s * lever[0] + c * lever[1] - y
                slow_x, slow_y = pipeline.slow_error_m(fix.sensor).tolist()
                self._last_m[outage] = math.hypot(dx, dy)
                self._errors_m.append((self._last_m[outage], math.hypot(dx + slow_x, dy + slow_y)))

    def report(self) -> dict[str, float | int | None]:
        """Number of judged fixes and their errors [m].

        end_m: rms of each outage's last. expected_: with the estimated slow error.
        """
        if not self._errors_m:
            return dict(NOTHING)
        (errors, expected), last = np.array(self._errors_m).T, np.array(list(self._last_m.values()))
        figures = (
            np.sqrt((errors**2).mean()),
            np.median(errors),
            errors.max(),
            np.sqrt((last**2).mean()),
            np.sqrt((expected**2).mean()),
            np.median(expected),
        )
        return {"fixes": len(errors), **dict(zip(FIGURES, (round(float(f), 3) for f in figures), strict=True))}

    def _is_withheld(self, reading: Reading) -> bool:
        self._first_ns = self._first_ns or reading.stamp_ns
        if not isinstance(reading, Gps | GpsVelocity) or reading.sensor not in self._sensors:
            return False
        was_dark, self._is_dark = self._is_dark, self._schedule.withholds(self._seconds(reading))
        self._outage += self._is_dark and not was_dark
        if self._is_dark and isinstance(reading, Gps):
            self._waiting.append((reading, self._outage))
        return self._is_dark

    def _true_ns(self, fix: Gps) -> int:
        return self._sensors[fix.sensor].true_ns(fix.stamp_ns)

    def _seconds(self, reading: Reading) -> float:
        return (reading.stamp_ns - self._first_ns) * 1e-9
