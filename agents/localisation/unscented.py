"""The unscented Kalman filter: filterpy's, all sigma points at once, and in a form whose covariance cannot go negative.

EVIDENCE: with filterpy 2.0 several `update()` after one `predict()` reuse stale sigma points, and the covariance goes
negative. Here each step draws its own. x, P = L L^T: belief, L_i: column of the factor, Q, R: noise.

The scaled unscented transform (van der Merwe 2004) takes a function g at x and at x +- gamma L_i, with
gamma^2 = alpha^2 (n + kappa). Of each pair the odd and the even part are

    d_i = (g+ - g-) / (2 gamma)      e_i = (g+ + g- - 2 g(x)) / (2 gamma)

Put into the usual sums, the weights (W_i = 1 / (2 gamma^2), and large ones of either sign at the centre) cancel to

    mean = g(x) + m,  m = sum(e_i) / gamma       covariance = sum(d_i d_i^T + e_i e_i^T) + (beta - alpha^2) m m^T

which is a sum of squares if beta >= alpha^2, whatever the sign of the centre's weight: the paper's lambda = 3 - n, and
alpha = 0.001, are safe in this form. The default is the paper's gamma^2 = 3, which is right to the fourth moment along
each axis, with beta = alpha^2, where the last term, which grows with n, vanishes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.conditioning import (
    bounded,
    conclude,
    definite,
    factor,
    is_usable,
    refused,
    wrapped,
    wrapped_state,
)
from protocol.arrays import Floats


@dataclass(frozen=True)
class Ukf:
    """Sees motion and measurement at points around the mean.

    alpha, beta, kappa: as in filterpy, kappa None for 3 - n. beta must not be below alpha^2.
    """

    alpha: float = 1.0
    beta: float = 1.0
    kappa: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.alpha < math.inf:
            raise ValueError("alpha: must be positive and finite")
        if not self.alpha**2 <= self.beta < math.inf:
            raise ValueError("beta: below alpha^2, a covariance could become negative")
        if self.kappa is not None and not math.isfinite(self.kappa):
            raise ValueError("kappa: must be finite")

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief through the motion."""
        ukf = self._at(belief)
        ukf.predict_with(motion)
        return Belief(stamp_ns, ukf.x, ukf.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not is_usable(measurement):
            return refused(belief, measurement)
        L, D, predicted, excess = self._at(belief).measured_with(measurement)
        return conclude(belief, measurement, predicted, L, D, measurement.R + excess)

    def _at(self, belief: Belief) -> VectorisedUkf:
        """A filter of filterpy's at the belief."""
        n = len(belief.x)
        return _template(n, self.alpha, self.beta, 3.0 - n if self.kappa is None else self.kappa).at(belief)


class VectorisedUkf(UnscentedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter without its loops over sigma points."""

    def __init__(self, n: int, alpha: float, beta: float, kappa: float) -> None:
        if n + kappa <= 0:
            raise ValueError(f"kappa: {kappa} is too small for {n} states")
        points = MerweScaledSigmaPoints(n, alpha=alpha, beta=beta, kappa=kappa)
        super().__init__(dim_x=n, dim_z=1, dt=1.0, hx=None, fx=None, points=points)
        self.x: Floats
        self.P: Floats
        self.gamma = alpha * math.sqrt(n + kappa)
        self.surplus = beta - alpha**2
        self.ones = np.ones(n)

    def at(self, belief: Belief) -> VectorisedUkf:
        """The same filter elsewhere; a copy, so that nothing is kept from step to step."""
        other = object.__new__(VectorisedUkf)  # a third of the cost of copy.copy
        other.__dict__ = {**self.__dict__, "x": belief.x, "P": belief.P}
        return other

    def predict_with(self, motion: Motion) -> None:
        """Set x and P to those after the motion."""
        parts, m, centre = self._parts(factor(self.P), motion.f, ())
        self.x = wrapped_state(centre + m, motion.angles)
        self.P = definite(bounded(self._square(parts, m) + motion.Q, motion.angles))

    def measured_with(self, measurement: Measurement) -> tuple[Floats, Floats, Floats, Floats]:
        """L (n, n), D (n, k), the measurement predicted (k,), and its covariance beyond D^T D (k, k)."""
        L = factor(self.P)
        parts, m, centre = self._parts(L, measurement.h, measurement.angles)
        n = len(L)
        return L, parts[:n], centre + m, self._square(parts[n:], m)

    def _parts(
        self, L: Floats, g: Callable[[Floats], Floats], angles: tuple[int, ...]
    ) -> tuple[Floats, Floats, Floats]:
        """d_i above e_i (2n, k), m (k,), g(x) (k,); differences of angles are wrapped."""
        n = len(L)
        spread = self.gamma * L.T
        points = np.empty((2 * n + 1, n))
        points[0] = self.x
        np.add(self.x, spread, out=points[1 : n + 1])
        np.subtract(self.x, spread, out=points[n + 1 :])
        values = g(points)
        centre = values[0]
        off = wrapped(values[1:] - centre, angles)
        parts = np.empty(off.shape)
        np.subtract(off[:n], off[n:], out=parts[:n])
        np.add(off[:n], off[n:], out=parts[n:])
        parts *= 0.5 / self.gamma
        return parts, self.ones @ parts[n:] / self.gamma, centre

    def _square(self, parts: Floats, m: Floats) -> Floats:
        """Sum of the squares of the parts (k, k), and the surplus of m."""
        square: Floats = parts.T @ parts
        return square + self.surplus * np.outer(m, m) if self.surplus else square


@lru_cache
def _template(n: int, alpha: float, beta: float, kappa: float) -> VectorisedUkf:
    return VectorisedUkf(n, alpha, beta, kappa)
