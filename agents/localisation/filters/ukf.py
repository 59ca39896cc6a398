"""The unscented Kalman filter, vectorised, in a form whose covariance cannot become negative.

filterpy's filter (`textbook.py`) agrees to 1e-9 per step, but can turn negative. x, P = L L^T: belief, L_i: column of
the factor, Q, R: noise.

The scaled unscented transform (van der Merwe 2004) evaluates g at x and at x +- gamma L_i, gamma^2 = alpha^2 (n +
kappa). Weights are W = 1 / (2 gamma^2), and large central ones that cancel: with d_j = g(x_j) - g(x) of the 2 n outer
points,

    mean = g(x) + m,  m = W sum(d_j)       covariance = W sum(d_j d_j^T) + (beta - alpha^2) m m^T

a sum of squares if beta >= alpha^2, so the paper's lambda = 3 - n and alpha = 0.001 are safe. The default, the paper's
gamma^2 = 3, is exact to the fourth moment along each axis; beta = alpha^2 removes the last term, which grows with n. In
d, the central column is sqrt((beta - alpha^2) / W) m, so the covariance is W d d^T.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg.blas import dtrsm

from agents.localisation.filters.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.filters.square_root import conclude, conclude_motion, noise_root, refused, root, wrapped
from protocol.arrays import Floats


@dataclass(frozen=True)
class Ukf:
    """Evaluates models at points around the mean.

    alpha, beta, kappa: of the scaled unscented transform; kappa None means 3 - n; beta at least alpha^2.
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
        """Move the belief."""
        points = self._points(len(belief.x), 0)
        _, d, mean = points.deviations(belief, motion.f, ())
        P = points.W * d.dot(d.T) + motion.Q  # with beta = alpha^2 around the centre
        if motion.at_centre:
            mean = motion.f(belief.x[None])[0]
        return conclude_motion(belief, motion, stamp_ns, mean, P, points.slope(d, belief))

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition; the prior if unusable or gated."""
        noise = noise_root(measurement)
        if noise is None:
            return refused(belief, measurement)
        k = len(noise)
        points = self._points(len(belief.x), k)
        of_x, d, mean = points.deviations(belief, measurement.h, measurement.angles)
        H = points.slope(d, belief)
        together = np.empty((k + len(of_x), d.shape[1]))
        np.multiply(points.root_W, d, out=together[:k])
        np.multiply(points.root_W, of_x, out=together[k:])
        together[:k, -k:] = noise
        return conclude(belief, measurement, mean, together, H)

    def _points(self, n: int, k: int) -> "SigmaPoints":
        return _sigma_points(n, k, self.alpha, self.beta, 3.0 - n if self.kappa is None else self.kappa)


class SigmaPoints:
    """Points and weights for n states and a measurement of k."""

    def __init__(self, n: int, k: int, alpha: float, beta: float, kappa: float) -> None:
        if n + kappa <= 0:
            raise ValueError(f"kappa: {kappa} is too small for {n} states")
        self.gamma = alpha * math.sqrt(n + kappa)
        self.W, self.root_W = 0.5 / self.gamma**2, math.sqrt(0.5) / self.gamma
        self.surplus = beta - alpha**2
        # In units of L: centre, pairs, and k times the centre, where noise deviates.
        directions = np.concatenate([np.zeros((n, 1)), np.eye(n), -np.eye(n), np.zeros((n, k))], axis=1)
        self.directions = self.gamma * directions
        self.weights = np.full(2 * n + 1 + k, self.W)

    def deviations(
        self, belief: Belief, g: Callable[[Floats], Floats], angles: tuple[int, ...]
    ) -> tuple[Floats, Floats, Floats]:
        """Deviations of x (n, 2 n + 1 + k) and d of g (j, 2 n + 1 + k), and the mean (j,) of g."""
        of_x = root(belief).dot(self.directions)
        values = g((of_x + belief.x[:, None]).T)
        centre = values[0]
        d = wrapped(values - centre, angles).T
        m = d.dot(self.weights)
        if self.surplus:
            d[:, 0] = math.sqrt(self.surplus / self.W) * m
        return of_x, d, centre + m

    def slope(self, d: Floats, belief: Belief) -> Floats | None:
        """Linear regression (j, n) of d of g on the state; None without a past.

        Statistical linearisation: g' L^-1 with g' = (d_+ - d_-) / (2 gamma) along the columns of L. By BLAS, as
        LAPACK's dtrtrs starts threads.
        """
        if belief.past is None:
            return None
        n = len(belief.x)
        along = (d[:, 1 : n + 1] - d[:, n + 1 : 2 * n + 1]) / (2 * self.gamma)
        slope: Floats = dtrsm(1.0, root(belief), along.T, lower=1, trans_a=1, overwrite_b=1).T
        return slope


@lru_cache
def _sigma_points(n: int, k: int, alpha: float, beta: float, kappa: float) -> SigmaPoints:
    return SigmaPoints(n, k, alpha, beta, kappa)
