"""filterpy's unscented Kalman filter, vectorised, with fresh sigma points between two updates.

EVIDENCE: with filterpy 2.0 several `update()` after one `predict()` reuse stale sigma points, and the covariance goes
negative; redrawing them costs one Cholesky factor. x: mean (n,), P: covariance (n, n), Q, R: process and measurement
noise, K: gain, S: innovation covariance, as in Labbe, "Kalman and Bayesian Filters in Python".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from protocol.arrays import Floats

# Functions of all sigma points at once: (2n + 1, n) -> (2n + 1, n) or (2n + 1, k).
Function = Callable[[Floats], Floats]


class VectorisedUkf(UnscentedKalmanFilter):  # type: ignore[misc]
    """Unscented Kalman filter over a Euclidean state; functions take all sigma points at once."""

    def __init__(self, x: Floats, P: Floats, alpha: float = 0.5, beta: float = 2.0) -> None:
        n = len(x)
        points = MerweScaledSigmaPoints(n, alpha=alpha, beta=beta, kappa=0.0)
        super().__init__(dim_x=n, dim_z=1, dt=1.0, hx=None, fx=None, points=points)
        self.x, self.P = x.copy(), P.copy()

    def predict_with(self, f: Function, Q: Floats) -> None:
        """Move the belief through `f` and add process noise."""
        sigmas = f(self.points_fn.sigma_points(self.x, self.P))
        self.x, self.P = self._moments(sigmas, self.x)
        self.P += Q

    def innovation(self, z: Floats, h: Function, R: Floats) -> tuple[Floats, Floats, Floats]:
        """Innovation y (k,), its covariance S (k, k), and the cross covariance (n, k) of state and measurement."""
        sigmas = self.points_fn.sigma_points(self.x, self.P)
        predicted = h(sigmas)
        z_mean, S = self._moments(predicted, z)
        cross = (sigmas - self.x).T @ (self.Wc[:, None] * (predicted - z_mean))
        return z - z_mean, S + R, cross

    def condition(self, y: Floats, S: Floats, cross: Floats) -> None:
        """Condition the belief on an innovation of this moment."""
        K = np.linalg.solve(S, cross.T).T
        self.x = self.x + K @ y
        self.P = self.P - K @ S @ K.T
        self.P = (self.P + self.P.T) / 2

    def _moments(self, sigmas: Floats, near: Floats) -> tuple[Floats, Floats]:
        """Weighted mean and covariance; taken about `near`, since the weights are large and opposite in sign."""
        centred = sigmas - near
        mean = self.Wm @ centred
        spread = centred - mean
        return near + mean, spread.T @ (self.Wc[:, None] * spread)
