"""Driver habits: lateral wander and random stops.

Drawn before the drive by distance driven, so habits depend on the machine's own generator alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.config import require_between

WANDER_STEP_M, WANDER_STEPS = 2.0, 4096  # point spacing; points, periodic after 8 km
RUN_UP_M = 40.0  # wander fades in: machines start on their lines
WIDEST = 2.5  # clip of the wander in standard deviations
STEEPEST = 0.05  # most wander over its length: hydraulics lag beyond, and the machine weaves
STOPS = 256  # drawn per driver, then periodic
SPREAD = (0.5, 1.5)  # distance between stops over its mean


@dataclass(frozen=True)
class DrivingConfig:
    """Deviation of drivers from their routes; none by default.

    wander_m: standard deviation of the lateral offset. wander_length_m: its correlation length along the route.
    stop_every_m: mean distance between stops, besides those at leg ends; None: no stops. stop_s: shortest and longest
    stop.
    """

    wander_m: float = 0.0
    wander_length_m: float = 40.0
    stop_every_m: float | None = None
    stop_s: tuple[float, float] = (5.0, 30.0)

    def __post_init__(self) -> None:
        require_between(self, 0, 1, "wander_m")
        require_between(self, 10, 1000, "wander_length_m")
        if self.wander_m > STEEPEST * self.wander_length_m:
            most_m = STEEPEST * self.wander_length_m
            problem = f"{self.wander_m:g} m is more than machines can steer with a wander_length_m of"
            raise ValueError(f"wander_m: {problem} {self.wander_length_m:g} m: at most {most_m:g} m")
        require_between(self, 20, 1e5, "stop_every_m")
        shortest, longest = self.stop_s
        if not 1 <= shortest <= longest <= 3600:
            raise ValueError(f"stop_s: {list(self.stop_s)} are not a shortest and a longest time from 1 to 3600 s")

    @property
    def widest_m(self) -> float:
        """Largest lateral offset."""
        return WIDEST * self.wander_m


@dataclass(frozen=True)
class Habits:
    """Habits of n drivers by distance driven, periodic.

    left_m: lateral offset (n, k), positive left, every WANDER_STEP_M. gap_m, stop_s: distance to the next stop,
    duration, (n, j).
    """

    left_m: Floats
    gap_m: Floats
    stop_s: Floats

    def lateral_m(self, driven_m: Floats) -> Floats:
        """Target offset (n,) after a distance driven (n,), positive left."""
        steps = driven_m / WANDER_STEP_M
        whole = np.floor(steps)
        number, count, driver = whole.astype(np.int64), self.left_m.shape[1], np.arange(len(steps))
        here, there = self.left_m[driver, number % count], self.left_m[driver, (number + 1) % count]
        lateral: Floats = np.minimum(driven_m / RUN_UP_M, 1.0) * (here + (steps - whole) * (there - here))
        return lateral

    def stop(self, number: Ints) -> tuple[Floats, Floats]:
        """Distance from the previous stop to stop `number` (n,), from 0, and its duration [s]."""
        which = np.arange(len(number)), number % self.gap_m.shape[1]
        return self.gap_m[which], self.stop_s[which]


def draw_habits(config: DrivingConfig, rngs: Sequence[np.random.Generator]) -> Habits:
    """One driver's habits per generator."""
    n = len(rngs)
    left_m, gap_m, stop_s = np.zeros((n, 1)), np.full((n, 1), np.inf), np.zeros((n, 1))
    if config.wander_m:
        white = np.array([rng.standard_normal(WANDER_STEPS) for rng in rngs])
        left_m = _wander(white, config.wander_m, config.wander_length_m)
    if config.stop_every_m is not None:
        shares = np.array([rng.uniform(*SPREAD, STOPS) for rng in rngs])
        gap_m, stop_s = config.stop_every_m * shares, np.array([rng.uniform(*config.stop_s, STOPS) for rng in rngs])
    return Habits(left_m, gap_m, stop_s)


def _wander(white: Floats, std_m: float, length_m: float) -> Floats:
    """Second-order Gauss-Markov process on a ring, from unit white noise (n, k).

    x'' + 2 b x' + b^2 x = w with b = 2 / length; correlation at distance d: (1 + b d) exp(-b d), with integral
    `length`. A first-order process has no direction to steer along.
    """
    steps = white.shape[1]
    per_m = 2 * np.pi * np.fft.rfftfreq(steps, WANDER_STEP_M)
    gain = 1 / (1 + (0.5 * length_m * per_m) ** 2)
    power = gain**2 @ np.where((per_m > 0) & (np.arange(len(gain)) < steps // 2), 2.0, 1.0) / steps
    left_m = np.fft.irfft(np.fft.rfft(white, axis=1) * gain, steps, axis=1) * (std_m / np.sqrt(power))
    kept: Floats = np.clip(left_m, -WIDEST * std_m, WIDEST * std_m)
    return kept
