"""Filters of the profile `paper`: filterpy's own UnscentedKalmanFilter and ExtendedKalmanFilter.

The paper's method runs on the field's textbook library; `ekf.py` and `ukf.py` serve the profile `default`. Added is
what filterpy leaves to users: models, wrapped angles, gates, and new sigma points before each measurement, as its
`update` reuses those of `predict`. With the paper's lambda = 3 - n the central weight is negative, so the result may be
no covariance: `DivergedError`.
"""

import math
from functools import partial
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from agents.localisation.filters.belief import Belief, Conditioned, DivergedError, Measurement, Motion
from agents.localisation.filters.square_root import noise_root, refused, wrapped, wrapped_state
from protocol.arrays import Floats

ALPHA, BETA = 1.0, 1.0  # with kappa = 3 - n, the paper's lambda and the weights of `Ukf`


class TextbookEkf:
    """filterpy's ExtendedKalmanFilter."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Predict: x <- f(x), P <- F P F^T + Q."""
        stock = _ekf(belief, 1)
        stock.Q, stock.F = motion.Q, motion.jacobian(belief.x)
        stock.predict()
        x = motion.f(belief.x[None])[0]  # filterpy's own is F x
        return _believed(stamp_ns, wrapped_state(x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition; the prior if unusable or gated."""
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
        """Move the belief."""
        stock = _ukf(belief, 1)
        stock.Q, stock.fx = motion.Q, lambda x, _: motion.f(x[None])[0]
        try:
            stock.predict()  # also draws points of the prediction
        except ValueError:  # LinAlgError is one
            raise DivergedError("the covariance is not positive definite") from None
        return _believed(stamp_ns, wrapped_state(stock.x, motion.angles), stock.P)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition; the prior if unusable or gated."""
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
    """Mean (k,) of points (m, k), with wrapped deviations of angles from the central one."""
    mean: Floats = points[0] + weights.dot(wrapped(points - points[0], angles))
    return mean


def _believed(stamp_ns: int, x: Floats, P: Floats) -> Belief:
    """The result, if finite with positive variances; factoring shows whether it is definite."""
    if not (math.isfinite(x.dot(x)) and np.isfinite(P).all() and P.diagonal().min() > 0):
        raise DivergedError("a variance is not positive")
    return Belief(stamp_ns, x, P)


def _concluded(belief: Belief, measurement: Measurement, stock: Any) -> Conditioned:
    nis = float(stock.y.dot(stock.SI).dot(stock.y))
    if not math.isfinite(nis) or nis < 0:
        raise DivergedError("the innovation covariance is not positive definite")
    if 0 < measurement.gate_sigma**2 < nis:
        return Conditioned(belief, stock.y, stock.S, nis, accepted=False)
    return Conditioned(_believed(belief.stamp_ns, stock.x, stock.P), stock.y, stock.S, nis, accepted=True)
