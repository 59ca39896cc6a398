"""Beliefs, motions and measurements: the values between the parts of localisation; and changes of a belief.

x: mean (n,), P: covariance (n, n), z: measurement (k,), R: its covariance (k, k), as in the filtering literature.

Whatever changes a belief but motions and measurements is here, since it maps the belief's past too (`smoother`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from agents.localisation.filters.smoother import Past
from agents.localisation.filters.state import SPEED, YAW, X, Y
from protocol.arrays import Floats
from protocol.rotations import wrap_angle


@dataclass(frozen=True, slots=True)
class Belief:
    """Mean and covariance of the state at a stamp; neither is written to.

    L: lower Cholesky factor of P, where it is known already; it saves computing it again. past: what it still says of
    the past, None where nothing is smoothed.
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
    """How the state moves over a time step.

    f: states (m, n) after the step from those before it, angles not wrapped. jacobian: df/dx (n, n) at a state (n,).
    Q: noise (n, n). angles: components of the state that are angles [rad]; a filter brings their mean into +-pi.
    at_centre: the mean moves as one state would, and is not the mean of all that the belief holds for possible. Places
    under an unsure heading lie on an arc, and their mean inside of it, where no machine can be.
    """

    f: Model
    jacobian: Model
    Q: Floats
    angles: tuple[int, ...]
    at_centre: bool = False


@dataclass(frozen=True, slots=True)
class Measurement:
    """A value of a sensor, with the model of the sensor: z = h(x) + noise of covariance R.

    h: measurements (m, k) that states (m, n) would give. jacobian: dh/dx (k, n) at a state (n,). angles: components of
    z that are angles [rad]. gate_sigma: refused if the innovation is this many standard deviations off, 0 never.
    relocks: accepted again after too many refusals in a row; false for assumptions, which no sensor measures. opens:
    states, (k,) each, that become as unsure as the measurement is off then, each on its own: they share what it is off
    by their variances, and the others follow by themselves. change: made to the belief at its stamp before any
    measurement, as when a state that was unknown gets its first value. considers: states that it depends on, and does
    not change (Schmidt-Kalman: Schmidt 1966).
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
        """Another value of the same sensor, with the same model; `replace` takes three times as long."""
        model, rest = (self.R, self.h, self.jacobian), (self.angles, self.gate_sigma, self.relocks)
        return Measurement(self.sensor, stamp_ns, z, *model, *rest, self.opens, self.change, self.considers)


@dataclass(frozen=True, slots=True)
class Conditioned:
    """A belief after a measurement: the prior unchanged where that was refused.

    innovation: (k,), its covariance: (k, k), nis: normalised innovation squared [-], NaN where nothing could be
    computed. accepted: whether the belief is conditioned on the measurement.
    """

    belief: Belief
    innovation: Floats
    innovation_covariance: Floats
    nis: float
    accepted: bool


@dataclass(frozen=True)
class PoseBelief:
    """Pose in `map` at a stamp: position [m], heading [rad, in +-pi], speed [m/s], covariance (2, 2) [m2].

    aid_share: how much of the position came from lanes, 0 to 1.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    covariance_m2: Floats
    aid_share: float = 0.0


class DivergedError(ArithmeticError):
    """What a filter computed is no covariance: nothing is left to go on with but a new start."""


class Filter(Protocol):
    """An EKF or UKF: pure steps, equal to use. One that does not repair its covariance raises DivergedError."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief through a motion, to its new stamp."""

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement of its stamp."""


def pose_of(belief: Belief, wheels_mps: float | None, aid_share: float = 0.0) -> PoseBelief:
    """The pose that a belief holds, with the wheels' speed; None: with its own."""
    speed_mps = float(belief.x[SPEED]) if wheels_mps is None else wheels_mps
    x, y, heading = float(belief.x[X]), float(belief.x[Y]), wrap_angle(float(belief.x[YAW]))
    return PoseBelief(belief.stamp_ns, x, y, heading, speed_mps, belief.P[:2, :2].copy(), aid_share)


# --- changes ---------------------------------------------------------------------------------------------------------


def extended(belief: Belief, variance: Floats) -> Belief:
    """The belief with more states at its end, zero, of variances (k,), and correlated with nothing."""
    n, more = len(belief.x), len(variance)
    P = np.diag(np.concatenate([np.zeros(n), variance]))
    P[:n, :n] = belief.P
    past = belief.past and belief.past.extended(more)
    return Belief(belief.stamp_ns, np.pad(belief.x, (0, more)), P, past=past)


def reset_states(belief: Belief, states: slice, variance: float) -> Belief:
    """The belief with these states at zero, of this variance and correlated with nothing."""
    x, P, M = belief.x.copy(), belief.P.copy(), np.eye(len(belief.x))
    x[states], P[states, :], P[:, states], M[states] = 0.0, 0.0, 0.0, 0.0
    P[states, states] = np.eye(states.stop - states.start) * variance
    return Belief(belief.stamp_ns, x, P, past=_mapped(belief, M))


def anchor_states(belief: Belief, states: slice, H: Floats, variance: float) -> Belief:
    """The belief with states e (k,) for the error of an anchor: e = -H (x_true - x) + v.

    H (k, n): Jacobian of what is anchored. variance: of v, whatever else makes the anchor wrong. A value that counts
    from the anchor measures H x + e, which is independent of x at this moment.
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
    """The belief with these states (k,) less sure by a covariance (k, k)."""
    P = belief.P.copy()
    P[states, states] += covariance
    return Belief(belief.stamp_ns, belief.x, P, past=belief.past)


def restate_states(belief: Belief, states: slice, before: float, after: float) -> Belief:
    """The belief with a stationary error of this variance instead of the one before.

    An error is a sum of errors that come and go: one that grows gets another part, which is independent of it. One that
    shrinks from e keeps, of variances s before and r after, r / s of it: the part that stays has covariance r with e.
    """
    kept = min(after / before, 1.0)
    x, M = belief.x.copy(), np.eye(len(belief.x))
    x[states] *= kept
    M[states, states] *= kept
    P = M @ belief.P @ M.T
    P[states, states] += np.eye(states.stop - states.start) * (after - kept**2 * before)
    return Belief(belief.stamp_ns, x, P, past=_mapped(belief, M))


def _mapped(belief: Belief, M: Floats) -> Past | None:
    """The past after a change that maps the state's error by M (n, n)."""
    return belief.past and belief.past.mapped(M)
