"""Slope along and across the machine: where the vertical points in the body's axes, by gyros and accelerometer.

The gyro carries the angle between two readings, gravity's share of the specific force holds it: what remains once the
wheels' own acceleration, and the centripetal one, are taken off. Angles are positive uphill: ahead, and to the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocol.units import GRAVITY_MPS2

MAX_SINE = 0.7  # steeper than any machine stands


@dataclass(frozen=True)
class AttitudeConfig:
    """Noise of the slope filters.

    force_std_mps2: of the specific force, vibration included. rate_walk: of the angle [rad/sqrt(s)]. bias_std_radps,
    bias_walk: gyro bias at start and its random walk per sqrt(s).
    """

    force_std_mps2: float = 0.35
    rate_walk: float = 1.5e-3
    bias_std_radps: float = 2e-3
    bias_walk: float = 3.5e-5

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")


class LeanFilter:
    """Direction of the vertical in `base_link`: its parts ahead and to the left are the sines of the two slopes.

    A vector that stands still turns in the body's axes by du/dt = -rates x u: a machine that turns on a slope swaps the
    slope ahead for the one across. Each part has a Kalman filter with the bias of the gyro about the other axis.
    """

    def __init__(self, config: AttitudeConfig) -> None:
        self.ahead, self.left = _Part(config), _Part(config)
        self._started = False

    def update(self, dt_s: float, rates_radps: tuple[float, float, float], force_mps2: tuple[float, float]) -> None:
        """Predict with the rates, correct with gravity's share of the specific force, ahead and to the left."""
        measured = [max(-MAX_SINE, min(MAX_SINE, force / GRAVITY_MPS2)) for force in force_mps2]
        if not self._started:
            self.ahead.sine, self.left.sine = measured
            self._started = True
            return
        x, y = self.ahead.sine, self.left.sine
        up = math.sqrt(max(1 - x * x - y * y, MAX_SINE**2))
        about_x, about_y, about_z = rates_radps
        self.ahead.update(dt_s, about_z * y - about_y * up, measured[0])
        self.left.update(dt_s, about_x * up - about_z * x, measured[1])


class _Part:
    """Kalman filter over the sine of one slope and the bias of the rate that changes it [rad/s]."""

    def __init__(self, config: AttitudeConfig) -> None:
        self.sine = 0.0
        self._config = config
        self._bias = 0.0
        self._p00, self._p01, self._p11 = 0.05**2, 0.0, config.bias_std_radps**2

    @property
    def angle_rad(self) -> float:
        """The slope, positive uphill."""
        return math.asin(max(-1.0, min(1.0, self.sine)))

    @property
    def variance(self) -> float:
        """Variance of the sine."""
        return self._p00

    def update(self, dt_s: float, change_per_s: float, measured: float) -> None:
        c = self._config
        self.sine += dt_s * (change_per_s - self._bias)
        p00, p01, p11 = self._p00, self._p01, self._p11
        p00 += dt_s * (dt_s * p11 - 2 * p01) + c.rate_walk**2 * dt_s
        p01 -= dt_s * p11
        p11 += c.bias_walk**2 * dt_s
        # vibration is taken as white over 10 ms: the variance of a reading grows as readings come faster
        noise = (c.force_std_mps2 / GRAVITY_MPS2) ** 2 * 0.02 / max(dt_s, 1e-3)
        innovation, total = measured - self.sine, p00 + noise
        gain, bias_gain = p00 / total, p01 / total
        self.sine += gain * innovation
        self._bias += bias_gain * innovation
        self._p00, self._p01, self._p11 = (1 - gain) * p00, (1 - gain) * p01, p11 - bias_gain * p01
