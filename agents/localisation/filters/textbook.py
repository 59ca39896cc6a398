"""The filters of the profile `paper`: filterpy's own UnscentedKalmanFilter and ExtendedKalmanFilter, as they are.

The paper's method runs on the field's textbook library, as its readers would build it; the square-root filters beside
it (`ekf.py`, `ukf.py`) are those of the profile `default`. What filterpy leaves to its users is added: models, wrapped
angles, gates, and sigma points drawn again before each measurement, since its `update` reuses those of `predict`.

With the paper's lambda = 3 - n the weight of the central point is negative, and P - K S K^T is a difference: what comes
out may be no covariance. Then nothing is left to go on with, and `DivergedError` says so.
"""

import math
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Conditioned, DivergedError, Measurement, Motion
from agents.localisation.filters.square_root import noise_root, refused, wrapped, wrapped_state
from protocol.arrays import Floats

ALPHA, BETA = 1.0, 1.0  # with kappa = 3 - n the paper's lambda, and the weights of `Ukf`


class TextbookEkf:
    """filterpy's ExtendedKalmanFilter."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief: x <- f(x), P <- F P F^T + Q."""
        stock = _ekf(belief, 1)
        stock.Q, stock.F = motion.Q, motion.jacobian(belief.x)
        stock.predict()
        x = motion.f(belief.x[None])[0]  # filterpy's own is F x
        return _believed(stamp_ns, wrapped_state(x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not _is_usable(measurement):
            return refused(belief, measurement)
        stock = _ekf(belief, len(measurement.z))
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
        stock = _ukf(belief, 1)
        stock.Q, stock.fx = motion.Q, lambda x, _: motion.f(x[None])[0]
        try:
            stock.predict()  # it draws points of the prediction too
        except ValueError:  # LinAlgError is one
            raise DivergedError("the covariance is not positive definite") from None
        return _believed(stamp_ns, wrapped_state(stock.x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not _is_usable(measurement):
            return refused(belief, measurement)
        stock = _ukf(belief, len(measurement.z))
        if angles := measurement.angles:
            stock.z_mean, stock.residual_z = partial(_mean, angles=angles), partial(_difference, angles=angles)
        try:
            stock.sigmas_f = stock.points_fn.sigma_points(stock.x, stock.P)
            stock.update(measurement.z, R=measurement.R, hx=lambda x: measurement.h(x[None])[0])
        except ValueError:  # LinAlgError is one
            raise DivergedError("the covariance is not positive definite") from None
        return _concluded(belief, measurement, stock)


def _ekf(belief: Belief, k: int) -> Any:
    stock = ExtendedKalmanFilter(len(belief.x), k)
    stock.x, stock.P = belief.x, belief.P
    return stock


def _ukf(belief: Belief, k: int) -> Any:
    n = len(belief.x)
    stock = UnscentedKalmanFilter(n, k, 0.0, None, None, MerweScaledSigmaPoints(n, ALPHA, BETA, 3.0 - n))
    stock.x, stock.P = belief.x, belief.P
    return stock


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


def _concluded(belief: Belief, measurement: Measurement, stock: Any) -> Conditioned:
    """What a filter made of a measurement, unless it is beyond its gate."""
    nis = float(stock.y.dot(stock.SI).dot(stock.y))
    if not math.isfinite(nis) or nis < 0:
        raise DivergedError("the innovation covariance is not positive definite")
    if 0 < measurement.gate_sigma**2 < nis:
        return Conditioned(belief, stock.y, stock.S, nis, accepted=False)
    return Conditioned(_believed(belief.stamp_ns, stock.x, stock.P), stock.y, stock.S, nis, accepted=True)
