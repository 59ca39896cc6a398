"""Slopes: the ground's profile that a machine felt, laid along its way over the map's, is one measurement of its place.

On a straight a lane shows nothing along the way, ground that undulates does. A window is PROFILE_M of slopes g_j, felt
at places d_j back from where it ended. On a grid of shifts s along the heading t, of a place q as in `matching`,

    log w(s) = log(N(g - G(q + s t + d); 0, C) + N(g; 0, C)) - s^2 / 2 t^T P t

G: the map's slope there along the machine. C: errors of both: roughness, which changes from day to day, the agent's own
noise and slow error, and an accelerometer's bias. The second density is of ground that has been shaped anew, or was
level: where the map explains no more of the profile than that, w tells nothing. The rest is as with lanes.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.lanes.matching import FLAT, GRID_SIGMA, MOST_NODES, moments, shown_by
from agents.localisation.lanes.window import LONGEST_NS, STEP_M
from protocol.arrays import Floats

PROFILE_M = 80.0  # of 50 and 80 m the one whose worst drive gained smoothed too (lab/results/fedback.md)
AFTER_NS = 60_000_000_000  # without slopes after the first: the attitude must have settled
LEAST_KNOWN = 0.7  # of a profile, at all shifts
VERY_STRONG = 5.0  # logarithm of how much better the map must explain a profile than level ground (Kass & Raftery 1995)
MOST_OFF = 1.0  # mean square of whitened errors; right profiles have 0.2 to 0.6, where a ramp has come 4 and more
# Deviations of slopes, and lengths in which they correlate, of two days at true places (lab/results/fedback.md)
ROUGH, ROUGH_M = 0.0055, 1.5
SLOW, SLOW_M = 0.002, 15.0
NOISE = 0.001
BIAS = 0.02  # of an accelerometer, 0.2 m/s2


@dataclass(frozen=True)
class GradeProfile:
    """Slopes felt along the machine (j,), way back to them in `map` (j, 2) [m], headings there (j,)."""

    slope: Floats
    back_m: Floats
    heading_rad: Floats


class SlopeWindow:
    """Collects the way by dead reckoning, and slopes, which follow some seconds later."""

    def __init__(self, load_centre_m: float) -> None:
        self._ahead_m = load_centre_m
        self._way: deque[tuple[int, float, float, float]] = deque()  # stamp, x, y [m], angle [rad]
        self._felt: deque[tuple[int, float, float]] = deque()  # stamp, slope, metres
        self._opens_ns = 0

    def add(self, reckoned: DeadReckonedPose) -> None:
        """Note where dead reckoning is."""
        at = reckoned.stamp_ns, reckoned.x_m, reckoned.y_m, reckoned.angle_rad
        while self._way and reckoned.stamp_ns - self._way[0][0] > LONGEST_NS:
            self._way.popleft()
        if not self._way or math.dist(self._way[-1][1:3], at[1:3]) >= STEP_M:
            self._way.append(at)

    def feel(self, stamp_ns: int, slope: float, metres: float) -> None:
        """Note the slope along the machine where it was at a stamp, over so many metres."""
        self._opens_ns = self._opens_ns or stamp_ns + AFTER_NS
        if stamp_ns >= self._opens_ns and math.isfinite(slope):
            self._felt.append((stamp_ns, slope, metres))

    def end(self, reckoned: DeadReckonedPose, heading_rad: float) -> GradeProfile | None:
        """The profile, if there is enough of it; then the next one begins. heading_rad: in `map`, where it is now."""
        self.add(reckoned)
        while self._felt and self._felt[0][0] < self._way[0][0]:
            self._felt.popleft()
        if sum(metres for *_, metres in self._felt) < PROFILE_M:
            return None
        stamps, slope, _ = np.array(self._felt).T
        self._felt.clear()
        way = np.array([*self._way, (reckoned.stamp_ns, reckoned.x_m, reckoned.y_m, reckoned.angle_rad)])
        x, y, angle = (np.interp(stamps, way[:, 0], way[:, i]) for i in (1, 2, 3))
        turn = heading_rad - reckoned.angle_rad
        c, s = math.cos(turn), math.sin(turn)
        place_m = np.stack([x + self._ahead_m * np.cos(angle), y + self._ahead_m * np.sin(angle)], axis=1)
        back_m = (place_m - (reckoned.x_m, reckoned.y_m)) @ np.array([[c, s], [-s, c]])
        return GradeProfile(slope, back_m, angle + turn)


def match_slopes(
    lanes: LaneMap, place_m: Floats, along_m2: float, heading_rad: float, profile: GradeProfile
) -> tuple[float, float] | str:
    """How far ahead on the map the machine is, and the variance [m, m2]; or why not: `unknown`, `unfit`, `flat`.

    place_m (2,), along_m2: the place and its variance along the heading, as believed.
    """
    std_m, step_m = math.sqrt(along_m2), lanes.cell_m / 2
    reach = min(max(math.ceil(GRID_SIGMA * std_m / step_m), 1), MOST_NODES)
    ahead_m = step_m * np.arange(-reach, reach + 1, dtype=np.float64)
    x, y = (
        place_m[:, None, None]
        + profile.back_m.T[:, None, :]
        + np.multiply.outer((math.cos(heading_rad), math.sin(heading_rad)), ahead_m)[:, :, None]
    )
    east, north = lanes.gradient(x, y)
    mapped = east * np.cos(profile.heading_rad) + north * np.sin(profile.heading_rad)
    known = np.isfinite(mapped).all(axis=0)
    if known.mean() < LEAST_KNOWN:
        return "unknown"
    L = np.linalg.cholesky(_covariance(profile.back_m[known]))
    off = np.vstack([profile.slope[known] - mapped[:, known], profile.slope[None, known]])
    fit = -0.5 * (np.linalg.solve(L, off.T) ** 2).sum(axis=0)
    if -2 * fit.max() > MOST_OFF * off.shape[1]:
        return "unfit"
    u: Floats = (ahead_m / std_m)[:, None]
    log_prior: Floats = -0.5 * u[:, 0] ** 2
    mean, V = moments(np.logaddexp(fit[:-1], fit[-1] + VERY_STRONG) + log_prior, u)
    left = V[0] / moments(log_prior, u)[1][0]
    if left[0] > FLAT:
        return "flat"
    off_u, variance = shown_by(mean, left, np.array([along_m2]))
    return std_m * float(off_u[0]), along_m2 * float(variance[0])


def _covariance(place_m: Floats) -> Floats:
    """Of the errors of slopes at places (j, 2)."""
    apart_m = np.linalg.norm(place_m[:, None] - place_m, axis=2)
    slow = BIAS**2 + SLOW**2 * np.exp(-apart_m / SLOW_M)
    covariance: Floats = slow + ROUGH**2 * np.exp(-((apart_m / ROUGH_M) ** 2)) + NOISE**2 * np.eye(len(place_m))
    return covariance
