"""Routes: closed loops, or cycles of open legs with stops; speed limits in curves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from protocol.arrays import Floats
from protocol.rotations import wrap_angle

SPACING_M, FINE_M = 0.5, 0.1  # point spacing of legs, and while rounding corners
ROUNDING_M = 7.0  # a right angle gets 0.886 times this radius, flatter corners more
LATERAL_MPS2 = 0.9
BRAKING_MPS2 = 0.5

Corners = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Leg:
    """Line of the machine's joint. points: (k, 2) in `map` [m], in driving order, spacing_m apart.

    closed: a loop. reverse: driven backwards. At the end of an open leg the machine waits wait_s, then carries
    payload_kg (None: unchanged).
    """

    points: Floats
    spacing_m: float
    closed: bool = False
    reverse: bool = False
    wait_s: float = 0.0
    payload_kg: float | None = None

    @property
    def length_m(self) -> float:
        """First to last point, or one lap."""
        return (len(self.points) - (not self.closed)) * self.spacing_m

    def headings(self) -> tuple[float, float]:
        """Direction of travel [rad] at the first and last point."""
        first, last = self.points[1] - self.points[0], self.points[-1] - self.points[-2]
        return float(np.arctan2(first[1], first[0])), float(np.arctan2(last[1], last[0]))

    def curvature(self) -> Floats:
        """Signed curvature per point [1/m], positive to the left; 0 at the ends of an open leg."""
        step = np.roll(self.points, -1, axis=0) - self.points
        heading = np.arctan2(step[:, 1], step[:, 0])
        turn = wrap_angle(heading - np.roll(heading, 1))
        if not self.closed:
            turn[[0, -1]] = 0.0
        curvature: Floats = turn / self.spacing_m
        return curvature


@dataclass(frozen=True)
class Route:
    """Cycle of a machine: one closed leg, or open legs end to end."""

    legs: tuple[Leg, ...]

    @property
    def length_m(self) -> float:
        """Length of one cycle."""
        return sum(leg.length_m for leg in self.legs)

    def reversed(self) -> Route:
        """The closed loop in the opposite direction."""
        (tour,) = self.legs
        return Route((replace(tour, points=tour.points[::-1].copy()),))


def tour(corners: Corners, rounding_m: float = ROUNDING_M) -> Route:
    """Closed route: a polygon, its corners rounded by a Gaussian of `rounding_m` along it."""
    outline = _resample(np.array([*corners, corners[0]], float), FINE_M, closed=True)
    points = _smooth(outline.points, rounding_m / outline.spacing_m)
    return Route((_resample(np.vstack([points, points[:1]]), SPACING_M, closed=True),))


def open_leg(corners: Corners, rounding_m: float = ROUNDING_M) -> Leg:
    """Open leg along corners; ends and end directions stay if the first and last straight are long."""
    outline = _resample(np.array(corners, float), FINE_M, closed=False).points
    # Point reflection keeps the ends in place.
    sigma = rounding_m / FINE_M
    margin = int(5 * sigma) + 1
    line = np.pad(outline, ((margin, margin), (0, 0)), "reflect", reflect_type="odd")
    points = _smooth(line, sigma)[margin : margin + len(outline)]
    return _resample(points, SPACING_M, closed=False)


def speed_limits(leg: Leg, drive_mps: float) -> Floats:
    """Target speed per point: limited by lateral acceleration, braking in time."""
    limit = np.minimum(np.sqrt(LATERAL_MPS2 / np.maximum(np.abs(leg.curvature()), 1e-6)), drive_mps)
    gain, laps = 2 * BRAKING_MPS2 * leg.spacing_m, 1 + leg.closed  # two laps, for the seam
    for i in reversed(range(laps * len(limit) - (not leg.closed))):
        k, following = i % len(limit), limit[(i + 1) % len(limit)]
        limit[k] = min(limit[k], np.sqrt(following**2 + gain))
    return limit


def _smooth(points: Floats, sigma: float) -> Floats:
    """Convolve a closed line (k, 2) with a Gaussian of `sigma` points."""
    gain = np.exp(-0.5 * (2 * np.pi * np.fft.fftfreq(len(points)) * sigma) ** 2)
    smooth = np.fft.ifft(np.fft.fft(points @ [1, 1j]) * gain)
    return np.stack([smooth.real, smooth.imag], axis=1)


def _resample(line: Floats, spacing_m: float, *, closed: bool) -> Leg:
    """Space points evenly along a line (k, 2); a closed line repeats its first point at the end."""
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    count = max(round(at[-1] / spacing_m), 2)
    even = np.linspace(0.0, at[-1], count + 1)[: count if closed else None]
    points = np.stack([np.interp(even, at, line[:, 0]), np.interp(even, at, line[:, 1])], axis=1)
    return Leg(points, float(at[-1] / count), closed)
