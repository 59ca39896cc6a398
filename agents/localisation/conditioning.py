"""What EKF and UKF share: square roots of covariances that never fail, and the conditioning on a measurement.

x: mean (n,), P = L L^T: its covariance (n, n) and lower Cholesky factor. z, R: measurement (k,) and covariance (k, k).
y: innovation, S: its covariance (k, k), K: gain (n, k). Both filters describe what the state says of the measurement by
D (n, k), with the covariance of state and measurement P H^T = L D, and by the rest M (k, k), with S = D^T D + M: noise,
and for the UKF what no linear function explains.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs  # a tenth of the cost of numpy.linalg on small matrices

from agents.localisation.belief import Belief, Conditioned, Measurement
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


def definite(P: Floats) -> Floats:
    """The covariance itself where it is positive definite by some margin, else one nearby that is."""
    L, failed = _cholesky(P)
    pivots = L.diagonal()
    return _repaired(P) if failed or P.diagonal() @ (1 / (pivots * pivots)) > MAX_INFLATION else P


def bounded(P: Floats, angles: tuple[int, ...]) -> Floats:
    """The covariance, with no angle less known than to a right angle.

    Without it the attitude of a machine whose tilt nobody measures is taken for linear over many turns, and the
    covariance of all else grows without end; and sigma points sqrt(3) deviations off would meet behind the back. Rows
    and columns are scaled, so what is definite stays so.
    """
    variance = P.diagonal()
    wide = [i for i in angles if variance[i] > UNKNOWN_ANGLE]
    if not wide:
        return P
    scale = np.ones(len(P))
    scale[wide] = np.sqrt(UNKNOWN_ANGLE / variance[wide])
    return P * np.outer(scale, scale)


def is_usable(measurement: Measurement) -> bool:
    """Whether z and R are finite and R is positive definite; of R the lower triangle counts."""
    z, R = measurement.z, measurement.R.ravel()
    return math.isfinite(z @ z + R @ R) and not _cholesky(measurement.R)[1]  # half the cost of isfinite().all()


def refused(belief: Belief, measurement: Measurement) -> Conditioned:
    """The belief as it was, and no innovation that could be computed."""
    k = len(measurement.z)
    return Conditioned(belief, np.full(k, np.nan), np.full((k, k), np.nan), math.nan, accepted=False)


def conclude(
    belief: Belief, measurement: Measurement, predicted: Floats, L: Floats, D: Floats, M: Floats
) -> Conditioned:
    """Gate the innovation, and condition the belief on it.

    predicted: (k,). With A = I - K H the covariance A P A^T + K M K^T (Joseph 1964) is a sum of squares, here of
    A L = L - K D^T and of K times the factor of M: it stays symmetric, and definite but for rounding.
    """
    y = wrapped(measurement.z - predicted, measurement.angles)
    S = D.T @ D + M
    if not math.isfinite(y @ y):
        return refused(belief, measurement)
    S_root = factor(S)
    nis = float(y @ dpotrs(S_root, y, lower=1)[0])
    if 0 < measurement.gate_sigma**2 < nis:
        return Conditioned(belief, y, S, nis, accepted=False)
    K = dpotrs(S_root, (L @ D).T, lower=1)[0].T
    n, k = D.shape
    root = np.empty((n, n + k))
    np.subtract(L, K @ D.T, out=root[:, :n])
    np.matmul(K, factor(M), out=root[:, n:])
    posterior = Belief(belief.stamp_ns, belief.x + K @ y, definite(root @ root.T))
    return Conditioned(posterior, y, S, nis, accepted=True)


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
