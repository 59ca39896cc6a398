"""Beliefs, motions, measurements, and changes of a belief.

x: mean (n,), P: covariance (n, n), z: measurement (k,), R: its covariance (k, k). Changes other than motions and
measurements are here, as they map the belief's past too (`smoother`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from agents.localisation.filters.smoother import Past
from agents.localisation.filters.state import SPEED, YAW, X, Y
from protocol.arrays import Floats
from protocol.rotations import wrap_angle

FREED = 10.0  # factor on prior variances: hardly anything is assumed then


@dataclass(frozen=True, slots=True)
class Belief:
    """Mean and covariance of the state at a stamp; immutable.

    L: lower Cholesky factor of P, if known. past: what it says of the past, None without smoothing.
    """

    stamp_ns: int
    x: Floats
    P: Floats
    L: Floats | None = field(default=None, repr=False, compare=False)
    past: Past | None = field(default=None, repr=False, compare=False)


Change = Callable[[Belief], Belief]
Model = Callable[[Floats], Floats]  # of states


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion over a time step.

    f: states (m, n) after it, angles not wrapped. jacobian: df/dx (n, n) at (n,). Q: noise (n, n). angles: components
    in rad, whose mean a filter wraps. at_centre: the mean moves as one state: with an uncertain heading, the belief's
    mean lies inside an arc of places, where no machine can be.
    """

    f: Model
    jacobian: Model
    Q: Floats
    angles: tuple[int, ...]
    at_centre: bool = False


@dataclass(frozen=True, slots=True)
class Measurement:
    """A sensor value with its model: z = h(x) + noise of covariance R.

    h: measurements (m, k) of states (m, n). jacobian: dh/dx (k, n) at (n,). angles: components of z in rad. gate_sigma:
    gate in standard deviations, 0 for none. relocks: accepted after too many refusals; not so assumptions. opens:
    states, (k,) each, whose variance then grows by the innovation, which they share by variance. change: applied to the
    belief first, as a state's first value. considers: states it depends on but does not change (Schmidt-Kalman: Schmidt
    1966).
    """

    sensor: str
    stamp_ns: int
    z: Floats
    R: Floats
    h: Model
    jacobian: Model
    angles: tuple[int, ...] = ()
    gate_sigma: float = 0.0
    relocks: bool = True
    opens: tuple[slice, ...] = ()
    change: Change | None = None
    considers: tuple[int, ...] = ()

    def at(self, stamp_ns: int, z: Floats) -> "Measurement":
        """Another value with the same model; three times as fast as `replace`."""
        model, rest = (self.R, self.h, self.jacobian), (self.angles, self.gate_sigma, self.relocks)
        return Measurement(self.sensor, stamp_ns, z, *model, *rest, self.opens, self.change, self.considers)


@dataclass(frozen=True, slots=True)
class Conditioned:
    """A belief after a measurement, or the unchanged prior. accepted: which of them.

    innovation: (k,), its covariance: (k, k), nis: normalised innovation squared [-], NaN if not computable.
    """

    belief: Belief
    innovation: Floats
    innovation_covariance: Floats
    nis: float
    accepted: bool


@dataclass(frozen=True)
class PoseBelief:
    """Pose in `map`: position [m], heading [rad, in +-pi], speed [m/s], covariance (2, 2).

    aid_share: share of the position that came from lanes, 0 to 1.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    covariance_m2: Floats
    aid_share: float = 0.0


class DivergedError(ArithmeticError):
    """No covariance came out; the filter must start again."""


class Filter(Protocol):
    """An EKF or UKF of pure steps. DivergedError if it does not repair its covariance."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief to a stamp."""

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition on a measurement of the belief's stamp."""


def pose_of(belief: Belief, wheels_mps: float | None, aid_share: float = 0.0) -> PoseBelief:
    """The belief's pose, with the wheels' speed; None: its own."""
    speed_mps = float(belief.x[SPEED]) if wheels_mps is None else wheels_mps
    x, y, heading = float(belief.x[X]), float(belief.x[Y]), wrap_angle(float(belief.x[YAW]))
    return PoseBelief(belief.stamp_ns, x, y, heading, speed_mps, belief.P[:2, :2].copy(), aid_share)


# --- changes ---------------------------------------------------------------------------------------------------------


def extended(belief: Belief, variance: Floats) -> Belief:
    """Append zero states of variances (k,), uncorrelated."""
    n, more = len(belief.x), len(variance)
    P = np.diag(np.concatenate([np.zeros(n), variance]))
    P[:n, :n] = belief.P
    past = belief.past and belief.past.extended(more)
    return Belief(belief.stamp_ns, np.pad(belief.x, (0, more)), P, past=past)


def reset_states(belief: Belief, states: slice, variance: float | Floats) -> Belief:
    """Set states (k,) to zero with this variance, or one each, uncorrelated."""
    x, P, M = belief.x.copy(), belief.P.copy(), np.eye(len(belief.x))
    x[states], P[states, :], P[:, states], M[states] = 0.0, 0.0, 0.0, 0.0
    P[states, states] = np.eye(states.stop - states.start) * variance
    return Belief(belief.stamp_ns, x, P, past=_mapped(belief, M))


def anchor_states(belief: Belief, states: slice, H: Floats, variance: float) -> Belief:
    """Set states e (k,) to the error of an anchor: e = -H (x_true - x) + v.

    H (k, n): Jacobian of what is anchored. variance: of v, the anchor's other errors. A value relative to the anchor
    measures H x + e, independent of x at this moment.
    """
    anchored = reset_states(belief, states, variance)
    P, M, others = anchored.P, np.eye(len(anchored.x)), np.ones(len(anchored.x), bool)
    others[states] = False
    seen = H @ P
    P[states, states] += seen @ H.T
    P[states, others] = -seen[:, others]
    P[others, states] = -seen[:, others].T
    M[states] = np.where(others, -H, 0.0)
    return Belief(belief.stamp_ns, anchored.x, P, past=_mapped(belief, M))


def open_states(belief: Belief, states: slice, covariance: Floats) -> Belief:
    """Add a covariance (k, k) to these states (k,)."""
    P = belief.P.copy()
    P[states, states] += covariance
    return Belief(belief.stamp_ns, belief.x, P, past=belief.past)


def freed(belief: Belief, states: slice, variance: Floats) -> Belief:
    """Widen the prior of states (k,), zero with variances (k,), by FREED afterwards, as if it had been so at first.

    A prior is a measurement of zero, and a measurement with negative information takes most of it back. The covariance
    stays definite, since a posterior is never wider than its prior.
    """
    seen, y, past = belief.P[states], -belief.x[states], belief.past
    R = -np.diag(np.maximum(variance, seen[:, states].diagonal()) / (1 - 1 / FREED))
    inverse = np.linalg.inv(seen[:, states] + R)
    K = seen.T.dot(inverse)
    if past is not None:
        shown = past.transition[states]
        past = past.informed(shown, shown.T.dot(inverse), y, K)
    return Belief(belief.stamp_ns, belief.x + K.dot(y), belief.P - K.dot(seen), past=past)


def restate_states(belief: Belief, states: slice, before: float, after: float) -> Belief:
    """Change the variance of a stationary error.

    A growing error gains an independent part. One that shrinks from e, with variances s before and r after, keeps r / s
    of e, as the remaining part has covariance r with e.
    """
    kept = min(after / before, 1.0)
    x, M = belief.x.copy(), np.eye(len(belief.x))
    x[states] *= kept
    M[states, states] *= kept
    P = M @ belief.P @ M.T
    P[states, states] += np.eye(states.stop - states.start) * (after - kept**2 * before)
    return Belief(belief.stamp_ns, x, P, past=_mapped(belief, M))


def _mapped(belief: Belief, M: Floats) -> Past | None:
    return belief.past and belief.past.mapped(M)
