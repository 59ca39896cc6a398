"""Closed routes: polygons with rounded corners, and the speed that their curves allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats

SPACING_M = 0.5
ROUNDING_M = 7.0  # of a right angle this leaves a radius of 0.886 times as much; flatter corners come out wider
LATERAL_MPS2 = 0.9
BRAKING_MPS2 = 0.5


@dataclass(frozen=True)
class Route:
    """A closed route. points: (n, 2) in `map` [m], evenly spaced by spacing_m; the last is followed by the first."""

    points: Floats
    spacing_m: float

    @property
    def length_m(self) -> float:
        """Length of one lap."""
        return len(self.points) * self.spacing_m

    def reversed(self) -> Route:
        """Return the same route driven the other way."""
        return Route(self.points[::-1].copy(), self.spacing_m)

    def shifted(self, share: float) -> Route:
        """Return the same route starting at this share of the lap."""
        return Route(np.roll(self.points, -round(share * len(self.points)), axis=0), self.spacing_m)

    def curvature(self) -> Floats:
        """Signed curvature at every point [1/m], positive to the left."""
        step = np.roll(self.points, -1, axis=0) - self.points
        heading = np.arctan2(step[:, 1], step[:, 0])
        turn = heading - np.roll(heading, 1)
        curvature: Floats = (turn + np.pi) % (2 * np.pi) - np.pi
        return curvature / self.spacing_m


def rounded(corners: tuple[tuple[float, float], ...], rounding_m: float = ROUNDING_M) -> Route:
    """Round a polygon: its outline convolved with a Gaussian of `rounding_m` along the way."""
    outline = resample(np.array(corners, float), SPACING_M)
    frequency = np.fft.fftfreq(len(outline.points), outline.spacing_m)
    gain = np.exp(-0.5 * (2 * np.pi * frequency * rounding_m) ** 2)
    smooth = np.fft.ifft(np.fft.fft(outline.points @ [1, 1j]) * gain)
    return resample(np.stack([smooth.real, smooth.imag], axis=1), SPACING_M)


def resample(points: Floats, spacing_m: float) -> Route:
    """Spread points evenly along the closed line through `points` (n, 2)."""
    closed = np.vstack([points, points[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = round(way[-1] / spacing_m)
    at = np.arange(count) * way[-1] / count
    even = np.stack([np.interp(at, way, closed[:, 0]), np.interp(at, way, closed[:, 1])], axis=1)
    return Route(even, float(way[-1] / count))


def speed_limits(route: Route, drive_mps: float) -> Floats:
    """Speed that a driver aims at, at every point: slow in curves, and braking for them in time."""
    limit = np.sqrt(LATERAL_MPS2 / np.maximum(np.abs(route.curvature()), 1e-6))
    limit = np.minimum(limit, drive_mps)
    gain = 2 * BRAKING_MPS2 * route.spacing_m
    for i in reversed(range(2 * len(limit))):  # twice round, so that the seam of the lap is treated like the rest
        k, following = i % len(limit), limit[(i + 1) % len(limit)]
        limit[k] = min(limit[k], np.sqrt(following**2 + gain))
    return limit
