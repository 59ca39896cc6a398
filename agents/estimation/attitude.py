"""Slope along and across the machine: a Kalman filter per axis over angle and gyro bias.

The gyro carries the angle between two readings, gravity's share of the specific force holds it: what remains once the
wheels' own acceleration, and the centripetal one, are taken off. Angles are positive uphill: ahead, and to the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from agents.physics import GRAVITY_MPS2


@dataclass(frozen=True)
class AttitudeConfig:
    """Noise of the slope filters.

    force_std_mps2: of the specific force, vibration included. rate_walk: of the angle [rad/sqrt(s)]. bias_std_radps,
    bias_walk: gyro bias at start and its random walk per sqrt(s).
    """

    force_std_mps2: float = 0.35
    rate_walk: float = 2.6e-3
    bias_std_radps: float = 2e-3
    bias_walk: float = 3.5e-5

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")


class SlopeFilter:
    """Kalman filter over one slope angle [rad] and the bias of the gyro about its axis [rad/s]."""

    def __init__(self, config: AttitudeConfig) -> None:
        self.angle_rad = 0.0
        self._config = config
        self._bias = 0.0
        self._started = False
        self._p00, self._p01, self._p11 = 0.05**2, 0.0, config.bias_std_radps**2

    @property
    def variance_rad2(self) -> float:
        """Variance of the angle."""
        return self._p00

    def update(self, dt_s: float, rate_radps: float, gravity_share_mps2: float) -> None:
        """Predict with the gyro's rate, correct with the part of gravity that lies along the axis."""
        measured = math.asin(max(-0.7, min(0.7, gravity_share_mps2 / GRAVITY_MPS2)))
        if not self._started:
            self.angle_rad, self._started = measured, True
            return
        c = self._config
        self.angle_rad += dt_s * (rate_radps - self._bias)
        p00, p01, p11 = self._p00, self._p01, self._p11
        p00 += dt_s * (dt_s * p11 - 2 * p01) + c.rate_walk**2 * dt_s
        p01 -= dt_s * p11
        p11 += c.bias_walk**2 * dt_s
        # vibration is taken as white over 10 ms: the variance of a reading grows as readings come faster
        noise = (c.force_std_mps2 / GRAVITY_MPS2) ** 2 * 0.02 / max(dt_s, 1e-3)
        innovation, total = measured - self.angle_rad, p00 + noise
        gain, bias_gain = p00 / total, p01 / total
        self.angle_rad += gain * innovation
        self._bias += bias_gain * innovation
        self._p00, self._p01, self._p11 = (1 - gain) * p00, (1 - gain) * p01, p11 - bias_gain * p01
