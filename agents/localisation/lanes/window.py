"""Windows: the places that a machine drove through, by dead reckoning, each in one window alone."""

from __future__ import annotations

import math

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from protocol.arrays import Floats

STEP_M = 1.0  # from place to place: a cell of the map
WINDOW_M = 20.0  # longer ones gain nothing, as dead reckoning turns
LONGEST_NS = 120_000_000_000  # of a window: a machine that stands for minutes may have been turned meanwhile


class Window:
    """Collects places of the load centre, which the map's samples are of."""

    def __init__(self, load_centre_m: float) -> None:
        self._ahead_m = load_centre_m
        self._last: DeadReckonedPose | None = None
        self._begin(0)

    def add(self, reckoned: DeadReckonedPose) -> bool:
        """Note where dead reckoning is; returns whether the window is full."""
        if reckoned.stamp_ns - self._begun_ns > LONGEST_NS:
            self._begin(reckoned.stamp_ns)
        elif self._last:
            self._driven_m += math.hypot(reckoned.x_m - self._last.x_m, reckoned.y_m - self._last.y_m)
        self._last = reckoned
        if self._driven_m >= STEP_M * len(self._places):
            c, s = math.cos(reckoned.angle_rad), math.sin(reckoned.angle_rad)
            at = reckoned.x_m + self._ahead_m * c, reckoned.y_m + self._ahead_m * s
            self._places.append((*at, reckoned.angle_rad))
        return self._driven_m >= WINDOW_M

    def end(self, heading_rad: float) -> tuple[Floats, Floats]:
        """Way back to each place (j, 2) in `map` [m], and the heading there (j,); the next window begins.

        heading_rad: of the machine where it was noted last.
        """
        last, places = self._last, np.array(self._places)
        assert last is not None, "a window without places"
        self._begin(last.stamp_ns)
        turn = heading_rad - last.angle_rad
        c, s = math.cos(turn), math.sin(turn)
        back_m = (places[:, :2] - (last.x_m, last.y_m)) @ np.array([[c, s], [-s, c]])
        return back_m, places[:, 2] + turn

    def _begin(self, stamp_ns: int) -> None:
        self._places: list[tuple[float, float, float]] = []  # x, y [m], angle [rad] by dead reckoning
        self._begun_ns, self._driven_m = stamp_ns, 0.0
