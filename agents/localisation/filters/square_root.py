"""What EKF and UKF share: square roots of covariances that never fail, and the conditioning on a measurement.

x: mean (n,), P = L L^T: its covariance (n, n) and lower Cholesky factor. z, R: measurement (k,) and covariance (k, k).
y: innovation, S: its covariance (k, k), K: gain (n, k). Both filters describe what they expect by m deviations from the
mean, Z (k, m) of the measurement together with X (n, m) of the state; noise deviates the measurement alone. Then

    P = X X^T      S = Z Z^T      K = X Z^T S^-1

On matrices this small `dot` takes half the time of `@`, and LAPACK itself a tenth of that of numpy.linalg.
"""

import math

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from agents.localisation.filters.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.filters.smoother import Past
from protocol.arrays import Floats

MIN_VARIANCE = 1e-18  # of any state, in its unit squared
MIN_EIGENVALUE = 1e-10  # of a repaired covariance, after scaling its diagonal to one
MAX_INFLATION = 1e13  # variances over what of them the states before leave unexplained, summed
UNKNOWN_ANGLE = (math.pi / 2) ** 2  # variance [rad2]: a right angle is as good as nothing known
TAU = 2 * math.pi


def wrapped(values: Floats, angles: tuple[int, ...]) -> Floats:
    """The same values (n,) or (m, n), of which those that are angles are brought into +-pi [rad]."""
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
    """Lower Cholesky factor of a covariance, or of the nearest one that is positive definite."""
    L, failed = _cholesky(P)
    return _cholesky(_repaired(P))[0] if failed else L


def root(belief: Belief) -> Floats:
    """Lower factor of the belief's covariance."""
    return factor(belief.P) if belief.L is None else belief.L


def definite(stamp_ns: int, x: Floats, P: Floats, past: Past | None = None) -> Belief:
    """A belief of that covariance where it is positive definite by some margin, else of one nearby that is."""
    L, failed = _cholesky(P)
    pivots = L.diagonal()
    if failed or P.diagonal().dot(np.reciprocal(pivots * pivots)) > MAX_INFLATION:
        P = _repaired(P)
        L = factor(P)
    return Belief(stamp_ns, x, P, L, past)


def conclude_motion(belief: Belief, motion: Motion, stamp_ns: int, x: Floats, P: Floats, F: Floats | None) -> Belief:
    """The belief after a motion to x, P. F (n, n): what it did to the state's error, None of a belief without a past.

    No angle is less known than to a right angle. Without that the attitude of a machine whose tilt nobody measures is
    taken for linear over many turns, and the covariance of all else grows without end; and sigma points sqrt(3)
    deviations off would meet behind the back. Rows and columns are scaled, so what is definite stays so.
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
    """Lower factor of R, of which the lower triangle counts; None unless R is finite and definite."""
    R = measurement.R.ravel()
    if not math.isfinite(R.dot(R)):  # half the cost of isfinite().all()
        return None
    L, failed = _cholesky(measurement.R)
    return None if failed else L


def refused(belief: Belief, measurement: Measurement) -> Conditioned:
    """The belief as it was, and no innovation that could be computed."""
    k = len(measurement.z)
    return Conditioned(belief, np.full(k, np.nan), np.full((k, k), np.nan), math.nan, accepted=False)


def conclude(
    belief: Belief, measurement: Measurement, predicted: Floats, together: Floats, H: Floats | None
) -> Conditioned:
    """Gate the innovation, and condition the belief on it.

    predicted: (k,). together: Z over X (k + n, m). H (k, n): how the measurement shows the state's error, None of a
    belief without a past. The covariance is the square of what the measurement leaves of the
    deviations, X - K Z: where the measurement is linear that is (I - K H) P (I - K H)^T + K R K^T (Joseph 1964). A sum
    of squares stays symmetric, and definite but for rounding; it holds for any gain K, so also for one that is zero for
    states that are only considered.
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
    if measurement.considers:  # the past learns all the same
        K = K.copy()
        K[list(measurement.considers)] = 0.0
    left = X - K.dot(Z)
    posterior = definite(belief.stamp_ns, belief.x + K.dot(y), left.dot(left.T), past)
    return Conditioned(posterior, y, S, nis, accepted=True)


def _divided(rows: Floats, S: Floats) -> Floats:
    """Rows (m, k) times S^-1, of S itself or of the nearest covariance that is positive definite."""
    _, solved, failed = dposv(S, rows.T, lower=1)
    if failed:
        _, solved, _ = dposv(_repaired(S), rows.T, lower=1)
    quotients: Floats = solved.T
    return quotients


def _cholesky(P: Floats) -> tuple[Floats, bool]:
    """Lower factor, and whether there is none. LAPACK lets NaN pass: it ends up on the last diagonal element."""
    L: Floats
    L, info = dpotrf(P, lower=1)
    return L, info != 0 or not math.isfinite(L[-1, -1])


def _repaired(P: Floats) -> Floats:
    """Raise the eigenvalues to a floor, scaled so that metres and biases count alike; a belief of NaN is an error."""
    if not np.isfinite(P).all():
        raise ValueError("the covariance is not finite")
    scale = np.sqrt(np.maximum(np.diag(P), MIN_VARIANCE))
    values, vectors = np.linalg.eigh((P + P.T) / 2 / np.outer(scale, scale))
    root: Floats = scale[:, None] * vectors * np.sqrt(np.maximum(values, MIN_EIGENVALUE))
    return root @ root.T
