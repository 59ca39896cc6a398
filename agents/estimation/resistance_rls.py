"""Recursive least squares with one forgetting factor per parameter, and rolling resistance and grade by it.

Vahidi, Stefanopoulou, Peng, "Recursive least squares with forgetting for online estimation of vehicle mass and road
grade", Vehicle System Dynamics 43 (2005): what changes slowly, the mass, forgets slowly; what changes at once, the
ground, forgets fast; and the gains of all share one denominator. With regressors h_i, gains and covariances are

    L_i = (P_i h_i / lambda_i) / (1 + sum_j P_j h_j^2 / lambda_j)      P_i <- (1 - L_i h_i) P_i / lambda_i

with L_i in the second alone, as if the others were known. Forgetting factors are per second here, as f in
lambda = f^dt, so that they mean the same at any rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.estimation.resistance import Push
from protocol.arrays import Floats

NEAR_NS = 500_000_000  # of a step that was usable
FIRST_C_RR = 0.03
MAX_VARIANCE = np.array([1e-2, 1.0])  # of scale and c_rr: what is not excited must not be forgotten without end


@dataclass(frozen=True)
class RecursiveConfig:
    """forget: share of the past that still counts a second later, for c_rr; forget_mass, forget_grade: for these.

    noise: of one raw c_rr, as a density [1/sqrt(Hz)], which states the variance.
    """

    forget: float = 0.6
    forget_mass: float = 0.995
    forget_grade: float = 0.2
    noise: float = 0.004

    def __post_init__(self) -> None:
        for name in ("forget", "forget_mass", "forget_grade"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: must be between 0 and 1")
        if not 0 < self.noise < math.inf:
            raise ValueError("noise: must be positive and finite")


class MultipleForgetting:
    """The algorithm: parameters (k,), variances (k,) in units of the noise, factors per second (k,)."""

    def __init__(self, start: Floats, variance: Floats, forget: Floats, most: Floats) -> None:
        self.parameters, self.variance = start.astype(float), variance.astype(float)
        self._forget, self._most = forget, most

    def update(self, dt_s: float, y: float, h: Floats) -> None:
        """Take in y = h . parameters + noise."""
        factor = self._forget**dt_s
        weight = self.variance * h / factor
        gain = weight / (1 + weight @ h)
        self.parameters = self.parameters + gain * (y - h @ self.parameters)
        alone = weight / (1 + weight * h)
        self.variance = np.minimum((1 - alone * h) * self.variance / factor, self._most)


class RecursiveResistance:
    """c_rr, and the scale error of drive force over mass where the mass is to be estimated."""

    def __init__(self, config: RecursiveConfig, *, estimates_mass: bool = False) -> None:
        self._config = config
        scale = 1e-3 if estimates_mass else 0.0
        forget, most = np.array([config.forget_mass, config.forget]), MAX_VARIANCE * [estimates_mass, 1]
        self._squares = MultipleForgetting(np.array([0.0, FIRST_C_RR]), np.array([scale, 1.0]), forget, most)
        self._stamp_ns = 0

    def update(self, push: Push) -> None:
        """Take in a step."""
        self._squares.update(push.dt_s, push.raw, np.array([push.share, push.regressor]))
        self._stamp_ns = push.stamp_ns

    def rest(self, *, changes_load: bool) -> None:
        """Forget the mass faster for once, if the load may change."""
        if changes_load:
            self._squares.variance[0] = min(10 * self._squares.variance[0], MAX_VARIANCE[0])

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """The newest estimate: it is late by as much as one waits for it."""
        if not self._stamp_ns or self._stamp_ns < stamp_ns - NEAR_NS:
            return None
        c_rr = float(self._squares.parameters[1])
        # the mean of white noise with exponential weights: half the share that is forgotten per second
        return c_rr, self._config.noise**2 * -math.log(self._config.forget) / 2


class RecursiveGrade:
    """Slope ahead [rad] from gravity's share of the specific force."""

    def __init__(self, config: RecursiveConfig) -> None:
        self._squares = MultipleForgetting(np.zeros(1), np.ones(1), np.array([config.forget_grade]), np.ones(1))

    def update(self, dt_s: float, sine: float) -> float:
        """Take in the sine of the slope as the accelerometer has it; returns the slope."""
        self._squares.update(dt_s, sine, np.ones(1))
        return math.asin(max(-0.9, min(0.9, float(self._squares.parameters[0]))))
