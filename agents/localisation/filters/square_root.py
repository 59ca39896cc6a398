"""Shared by EKF and UKF: square roots of covariances that never fail, and conditioning.

x: mean (n,), P = L L^T: covariance (n, n), lower Cholesky factor. z, R: measurement (k,), covariance (k, k). y:
innovation, S: its covariance (k, k), K: gain (n, k). Both filters give m deviations from the mean, Z (k, m) of the
measurement and X (n, m) of the state; noise deviates Z alone:

    P = X X^T      S = Z Z^T      K = X Z^T S^-1

On small matrices `dot` takes half the time of `@`, and LAPACK itself a tenth of numpy.linalg's.
"""

import math

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from agents.localisation.filters.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.filters.smoother import Past
from protocol.arrays import Floats

MIN_VARIANCE = 1e-18  # variance floor of any state, in its unit squared
MIN_EIGENVALUE = 1e-10  # eigenvalue floor of a repaired covariance with unit diagonal
MAX_INFLATION = 1e13  # upper bound of the sum of variance over unexplained variance
UNKNOWN_ANGLE = (math.pi / 2) ** 2  # variance [rad2] of a right angle, as good as unknown
TAU = 2 * math.pi


def wrapped(values: Floats, angles: tuple[int, ...]) -> Floats:
    """Values (n,) or (m, n) with angles wrapped to +-pi [rad]."""
    if not angles:
        return values
    values = values.copy()
    for i in angles:
        values[..., i] -= TAU * np.rint(values[..., i] / TAU)
    return values


def wrapped_state(x: Floats, angles: tuple[int, ...]) -> Floats:
    """The same for one state (n,), faster."""
    x = x.copy()
    for i in angles:
        x[i] = math.remainder(x[i], TAU)
    return x


def factor(P: Floats) -> Floats:
    """Lower Cholesky factor of a covariance, repaired if necessary."""
    L, failed = _cholesky(P)
    return _cholesky(_repaired(P))[0] if failed else L


def root(belief: Belief) -> Floats:
    """Lower factor of the belief's covariance."""
    return factor(belief.P) if belief.L is None else belief.L


def definite(stamp_ns: int, x: Floats, P: Floats, past: Past | None = None) -> Belief:
    """A belief of this covariance, repaired if it is not safely positive definite."""
    L, failed = _cholesky(P)
    pivots = L.diagonal()
    if failed or P.diagonal().dot(np.reciprocal(pivots * pivots)) > MAX_INFLATION:
        P = _repaired(P)
        L = factor(P)
    return Belief(stamp_ns, x, P, L, past)


def conclude_motion(belief: Belief, motion: Motion, stamp_ns: int, x: Floats, P: Floats, F: Floats | None) -> Belief:
    """The belief after a motion to x, P. F (n, n): map of the state's error, None without a past.

    Angle variances stop at a right angle. Else an unmeasured tilt counts as linear over many turns, covariances grow
    without bound, and sigma points meet behind the back. Scaling rows and columns keeps it definite.
    """
    variance = P.diagonal()
    wide = [i for i in motion.angles if variance[i] > UNKNOWN_ANGLE]
    if wide:
        scale = np.ones(len(P))
        scale[wide] = np.sqrt(UNKNOWN_ANGLE / variance[wide])
        P = P * np.outer(scale, scale)
        F = None if F is None else scale[:, None] * F
    past = belief.past
    if past is not None and F is not None:
        past = past.advanced(belief.stamp_ns, belief.x, belief.P, F, stamp_ns)
    return definite(stamp_ns, wrapped_state(x, motion.angles), P, past)


def noise_root(measurement: Measurement) -> Floats | None:
    """Lower factor of R (lower triangle); None unless finite and definite."""
    R = measurement.R.ravel()
    if not math.isfinite(R.dot(R)):  # half the cost of isfinite().all()
        return None
    L, failed = _cholesky(measurement.R)
    return None if failed else L


def refused(belief: Belief, measurement: Measurement) -> Conditioned:
    """The unchanged belief without an innovation."""
    k = len(measurement.z)
    return Conditioned(belief, np.full(k, np.nan), np.full((k, k), np.nan), math.nan, accepted=False)


def conclude(
    belief: Belief, measurement: Measurement, predicted: Floats, together: Floats, H: Floats | None
) -> Conditioned:
    """Gate the innovation, and condition the belief.

    predicted: (k,). together: Z over X (k + n, m). H (k, n): measurement Jacobian, None without a past. The posterior
    covariance is the square of X - K Z; for a linear measurement (I - K H) P (I - K H)^T + K R K^T (Joseph 1964).
    Squares stay symmetric and definite for any gain K, also zero for considered states.
    """
    y = wrapped(measurement.z - predicted, measurement.angles)
    if not math.isfinite(y.dot(y)):
        return refused(belief, measurement)
    k = len(y)
    Z, X, rows = together[:k], together[k:], np.empty((len(together) + 1, k))
    together.dot(Z.T, rows[:-1])
    rows[-1] = y
    S, quotients = rows[:k], _divided(rows[k:], rows[:k])
    K, nis = quotients[:-1], float(quotients[-1].dot(y))
    if 0 < measurement.gate_sigma**2 < nis:
        return Conditioned(belief, y, S, nis, accepted=False)
    past = belief.past
    if past is not None and H is not None:
        shown = H.dot(past.transition)
        past = past.informed(shown, _divided(shown.T, S), y, K)
    if measurement.considers:  # the past still learns
        K = K.copy()
        K[list(measurement.considers)] = 0.0
    left = X - K.dot(Z)
    posterior = definite(belief.stamp_ns, belief.x + K.dot(y), left.dot(left.T), past)
    return Conditioned(posterior, y, S, nis, accepted=True)


def _divided(rows: Floats, S: Floats) -> Floats:
    """Rows (m, k) times S^-1, S repaired if necessary."""
    _, solved, failed = dposv(S, rows.T, lower=1)
    if failed:
        _, solved, _ = dposv(_repaired(S), rows.T, lower=1)
    quotients: Floats = solved.T
    return quotients


def _cholesky(P: Floats) -> tuple[Floats, bool]:
    """Lower factor, and whether it failed. LAPACK passes NaN on to the last diagonal element."""
    L: Floats
    L, info = dpotrf(P, lower=1)
    return L, info != 0 or not math.isfinite(L[-1, -1])


def _repaired(P: Floats) -> Floats:
    """Raise eigenvalues to a floor, scaled to unit diagonal; ValueError for NaN."""
    if not np.isfinite(P).all():
        raise ValueError("the covariance is not finite")
    scale = np.sqrt(np.maximum(np.diag(P), MIN_VARIANCE))
    values, vectors = np.linalg.eigh((P + P.T) / 2 / np.outer(scale, scale))
    root: Floats = scale[:, None] * vectors * np.sqrt(np.maximum(values, MIN_EIGENVALUE))
    return root @ root.T
