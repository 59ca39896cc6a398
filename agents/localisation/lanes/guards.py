"""What keeps lanes from pulling a machine where it is not: two states, and alarms that turn the aid off for a while.

m: the map's offset, east and north. l: how far to the left of the fleet's lanes this machine keeps, a Gauss-Markov
process, as drivers and roads differ. A match measures p + m + l n, n to the left of the heading t; slopes measure
t (p + m). Fixes, which know nothing of m and l, tell these from the place in the long run, and bends tell l at once.
After an alarm the place is what it would be if hardly anything had been assumed of m and l (`freed`): lanes pull it no
longer.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from agents.localisation.filters.motion import BESIDE_STD_M
from protocol.arrays import Floats

OFFSET_STD_M, YOUNG_OFFSET_STD_M = 1.0, 1.5  # of m; of a map of one day, whose errors are partly the machine's own
AFTER_NS = 30_000_000_000  # without lanes after the heading is proven: the filter must have settled
OFF_NS = 300_000_000_000  # after an alarm
ALARM_SIGMA = 2.0  # m or l further from 0 than so many of their standard deviations: lanes are elsewhere
WINDOWS, MOST_NIS = 8, 2.0  # mean of so many normalised innovations squared per component, 1 if all is right
ALARMS = {
    "map_moved": "the map's lanes lie elsewhere",
    "beside_lanes": "the machine keeps beside the map's lanes",
    "contradicted": "the map's lanes contradict the other sensors",
}


def prior_m2(*, young: bool) -> Floats:
    """Variances (3,) of m and l before anything is known of them. young: whether the map is of one day."""
    offset_m = YOUNG_OFFSET_STD_M if young else OFFSET_STD_M
    return np.array([offset_m**2, offset_m**2, BESIDE_STD_M**2])


def shown(states: int, heading_rad: float) -> Floats:
    """Jacobian (2, states) of a match, for states that end with m and l."""
    H = np.zeros((2, states))
    H[0, 0] = H[1, 1] = H[0, -3] = H[1, -2] = 1.0
    H[:, -1] = -math.sin(heading_rad), math.cos(heading_rad)
    return H


def share_of(cross_m2: Floats, offset_m2: float) -> float:
    """How much of a place came from lanes, 0 to 1: how far it would move if the whole map were moved by a metre.

    cross_m2 (2, 2): covariance of the place with m now, of a prior variance offset_m2. A map that is moved is a prior
    of m with another mean, and the mean of the place follows that by cov(p, m) / var(m).
    """
    return min(float(np.linalg.norm(cross_m2, 2)) / offset_m2, 1.0)


class Guards:
    """Decides whether lanes are used now. alarm: of ALARMS, why they are not; empty where that is not it."""

    def __init__(self) -> None:
        self.alarm = ""
        self._opens_ns = 0
        self._nis: deque[float] = deque(maxlen=WINDOWS)

    def is_open(self, stamp_ns: int) -> bool:
        """Whether lanes may be used."""
        if not self._opens_ns:
            self._opens_ns = stamp_ns + AFTER_NS
        if is_open := stamp_ns >= self._opens_ns:
            self.alarm = ""
        return is_open

    def judge(self, stamp_ns: int, mean: Floats, variance: Floats, nis: float) -> str:
        """The alarm after a match; then lanes are off from now on. mean (3,): of m and l, variance: their prior."""
        self._nis.append(nis)
        east, north, beside = mean**2 / variance
        alarms = {
            "map_moved": east + north > ALARM_SIGMA**2,
            "beside_lanes": beside > ALARM_SIGMA**2,
            "contradicted": len(self._nis) == WINDOWS and sum(self._nis) > MOST_NIS * WINDOWS,
        }
        self.alarm = next((name for name, rings in alarms.items() if rings), "")
        if self.alarm:
            self._opens_ns = stamp_ns + OFF_NS
            self._nis.clear()
        return self.alarm
