"""The filters of the profile `paper`: filterpy's own UnscentedKalmanFilter and ExtendedKalmanFilter.

The paper's method runs on the field's textbook library, as its readers would build it; the square-root filters beside
it (`ekf.py`, `ukf.py`) are those of the profile `default`. The sums are filterpy's; what it leaves to its users is
added: models, wrapped angles, gates, and sigma points drawn again before each measurement, since its `update` reuses
those of `predict`. The models answer for all sigma points at once, not point after point. So are the sums made,
in filterpy's order: no bit of a result differs.

With the paper's lambda = 3 - n the weight of the central point is negative, and P - K S K^T is a difference: what comes
out may be no covariance. Then nothing is left to go on with, and `DivergedError` says so.
"""

import math
from collections.abc import Callable
from copy import copy
from functools import lru_cache, partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.linalg.lapack import dpotrf

from agents.localisation.filters.belief import Belief, Conditioned, DivergedError, Measurement, Model, Motion
from agents.localisation.filters.square_root import noise_root, refused, wrapped, wrapped_state
from protocol.arrays import Floats

Mean = Callable[[Floats, Floats], Floats]  # of points, with weights
Residual = Callable[[Floats, Floats], Floats]
ALPHA, BETA = 1.0, 1.0  # with kappa = 3 - n the paper's lambda, and the weights of `Ukf`
SPREAD = 3.0  # lambda + n


class _Extended(ExtendedKalmanFilter):  # type: ignore[misc]
    """With a motion that is not linear: filterpy asks for this method to be replaced then."""

    x: Floats
    f: Model

    def predict_x(self, u: object = 0) -> None:  # noqa: ARG002 - nothing controls the machine here
        self.x = self.f(self.x[None])[0]


class _Points(MerweScaledSigmaPoints):  # type: ignore[misc]
    """Drawn at once: the rows of the root of (lambda + n) P, added to the mean and taken off it."""

    def sigma_points(self, x: Floats, P: Floats) -> Floats:
        n, U = self.n, _upper_root(SPREAD * P)
        points = np.empty((2 * n + 1, n))
        points[0] = x
        np.add(x, U, out=points[1 : n + 1])
        np.subtract(x, U, out=points[n + 1 :])
        return points


class _Unscented(UnscentedKalmanFilter):  # type: ignore[misc]
    """With a motion and sums of all sigma points at once."""

    f: Model

    def compute_process_sigmas(self, dt: float, fx: object = None, **_: object) -> None:  # noqa: ARG002
        self.sigmas_f = self.f(self.points_fn.sigma_points(self.x, self.P))

    def cross_variance(self, x: Floats, z: Floats, sigmas_f: Floats, sigmas_h: Floats) -> Floats:
        """Of points (1, m, n) and (1, m, k) in the place of one, as `condition` gives them."""
        return _weighted(self.Wc, self.residual_x(sigmas_f[0], x), self.residual_z(sigmas_h[0], z))


class TextbookEkf:
    """filterpy's ExtendedKalmanFilter."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief: x <- f(x), P <- F P F^T + Q."""
        stock = copy(_ekf(len(belief.x), 1))
        stock.x, stock.P, stock.Q, stock.F, stock.f = belief.x, belief.P, motion.Q, motion.jacobian(belief.x), motion.f
        stock.predict()
        return _believed(stamp_ns, wrapped_state(stock.x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not _is_usable(measurement):
            return refused(belief, measurement)
        stock = copy(_ekf(len(belief.x), len(measurement.z)))
        stock.x, stock.P = belief.x, belief.P
        residual = partial(_difference, angles=measurement.angles)
        hx = lambda x: measurement.h(x[None])[0]  # noqa: E731
        try:
            stock.update(measurement.z, measurement.jacobian, hx, R=measurement.R, residual=residual)
        except ValueError:  # LinAlgError is one
            raise DivergedError("the innovation covariance is singular") from None
        return _concluded(belief, measurement, stock)


class TextbookUkf:
    """filterpy's UnscentedKalmanFilter with van der Merwe's scaled sigma points."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief through the motion."""
        stock = copy(_ukf(len(belief.x), 1))
        stock.x, stock.P, stock.Q, stock.f = belief.x, belief.P, motion.Q, motion.f
        try:
            stock.predict(UT=_transformed)  # it draws points of the prediction too
        except ValueError:  # LinAlgError is one
            raise DivergedError("the covariance is not positive definite") from None
        return _believed(stamp_ns, wrapped_state(stock.x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not _is_usable(measurement):
            return refused(belief, measurement)
        stock = copy(_ukf(len(belief.x), len(measurement.z)))
        stock.x, stock.P = belief.x, belief.P
        if angles := measurement.angles:
            stock.z_mean, stock.residual_z = partial(_mean, angles=angles), partial(_difference, angles=angles)
        try:
            stock.sigmas_f = stock.points_fn.sigma_points(stock.x, stock.P)[None]  # all of them, in the place of one
            stock.update(measurement.z, R=measurement.R, UT=_transformed_one, hx=measurement.h)
        except ValueError:  # LinAlgError is one
            raise DivergedError("the covariance is not positive definite") from None
        return _concluded(belief, measurement, stock)


# Filters with nothing in them yet, to be copied in a quarter of the time that a new one takes. filterpy replaces arrays
# and writes to none, so copies may share them.
@lru_cache
def _ekf(n: int, k: int) -> _Extended:
    return _Extended(n, k)


@lru_cache
def _ukf(n: int, k: int) -> _Unscented:
    return _Unscented(n, k, 0.0, None, None, _Points(n, ALPHA, BETA, SPREAD - n))


def _upper_root(P: Floats) -> Floats:
    """Upper Cholesky factor, as scipy's `cholesky` has it for more than twice the time; raises ValueError."""
    U: Floats
    U, info = dpotrf(P)
    if info or not math.isfinite(U[-1, -1]):
        raise ValueError("not positive definite")
    return U


def _transformed(
    points: Floats, Wm: Floats, Wc: Floats, noise: Floats, mean: Mean | None, residual: Residual
) -> tuple[Floats, Floats]:
    """Mean (k,) and covariance (k, k) of points (m, k), as filterpy's `unscented_transform` has them."""
    x = Wm.dot(points) if mean is None else mean(points, Wm)
    y = residual(points, x)
    P = y.T.dot(np.multiply(Wc[:, None], y, order="C")) if residual is np.subtract else _weighted(Wc, y, y)
    return x, P + noise


def _transformed_one(points: Floats, *rest: Any) -> tuple[Floats, Floats]:
    """The same of points (1, m, k) in the place of one."""
    return _transformed(points[0], *rest)


def _weighted(weights: Floats, a: Floats, b: Floats) -> Floats:
    """Sum (n, k) of weights (m,) times the outer products of a (m, n) and b (m, k), one after the other.

    numpy adds in this order along an axis whose values do not adjoin; those that do, in pairs.
    """
    terms = np.multiply(a[:, :, None], b[:, None, :], order="C")
    terms *= weights[:, None, None]
    total: Floats = terms.sum(axis=0) if terms[0].size > 1 else terms.cumsum(axis=0)[-1]
    return total


def _is_usable(measurement: Measurement) -> bool:
    return bool(np.isfinite(measurement.z).all()) and noise_root(measurement) is not None


def _difference(a: Floats, b: Floats, angles: tuple[int, ...]) -> Floats:
    return wrapped(a - b, angles)


def _mean(points: Floats, weights: Floats, angles: tuple[int, ...]) -> Floats:
    """Mean (k,) of points (m, k), whose deviations from the central one are wrapped where they are angles."""
    mean: Floats = points[0] + weights.dot(wrapped(points - points[0], angles))
    return mean


def _believed(stamp_ns: int, x: Floats, P: Floats) -> Belief:
    """What came out, where it is a mean and may be a covariance; whether it is definite shows when it is factored."""
    if not (math.isfinite(x.dot(x)) and np.isfinite(P).all() and P.diagonal().min() > 0):
        raise DivergedError("a variance is not positive")
    return Belief(stamp_ns, x, P)


def _concluded(
    belief: Belief, measurement: Measurement, stock: ExtendedKalmanFilter | UnscentedKalmanFilter
) -> Conditioned:
    """What a filter made of a measurement, unless it is beyond its gate."""
    nis = float(stock.y.dot(stock.SI).dot(stock.y))
    if not math.isfinite(nis) or nis < 0:
        raise DivergedError("the innovation covariance is not positive definite")
    if 0 < measurement.gate_sigma**2 < nis:
        return Conditioned(belief, stock.y, stock.S, nis, accepted=False)
    return Conditioned(_believed(belief.stamp_ns, stock.x, stock.P), stock.y, stock.S, nis, accepted=True)
