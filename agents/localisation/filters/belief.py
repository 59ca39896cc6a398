"""Beliefs, motions and measurements: the values between the parts of localisation.

x: mean (n,), P: covariance (n, n), z: measurement (k,), R: its covariance (k, k), as in the filtering literature.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from protocol.arrays import Floats


@dataclass(frozen=True, slots=True)
class Belief:
    """Mean and covariance of the state at a stamp; neither is written to.

    L: lower Cholesky factor of P, where it is known already; it saves computing it again.
    """

    stamp_ns: int
    x: Floats
    P: Floats
    L: Floats | None = field(default=None, repr=False, compare=False)


Change = Callable[[Belief], Belief]
Model = Callable[[Floats], Floats]  # of states


@dataclass(frozen=True, slots=True)
class Motion:
    """How the state moves over a time step.

    f: states (m, n) after the step from those before it, angles not wrapped. jacobian: df/dx (n, n) at a state (n,).
    Q: noise (n, n). angles: components of the state that are angles [rad]; a filter brings their mean into +-pi.
    """

    f: Model
    jacobian: Model
    Q: Floats
    angles: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Measurement:
    """A value of a sensor, with the model of the sensor: z = h(x) + noise of covariance R.

    h: measurements (m, k) that states (m, n) would give. jacobian: dh/dx (k, n) at a state (n,). angles: components of
    z that are angles [rad]. gate_sigma: refused if the innovation is this many standard deviations off, 0 never.
    relocks: accepted again after too many refusals in a row; false for assumptions, which no sensor measures. opens:
    states (k,) that become as unsure as the measurement is off then; the others follow by themselves. change: made to
    the belief at its stamp before any measurement, as when a state that was unknown gets its first value.
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
    opens: slice | None = None
    change: Change | None = None


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
    """Pose in `map` at a stamp: position [m], heading [rad, in +-pi], wheel speed [m/s], covariance (2, 2) [m2]."""

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    covariance_m2: Floats


class DivergedError(ArithmeticError):
    """What a filter computed is no covariance: nothing is left to go on with but a new start."""


class Filter(Protocol):
    """An EKF or UKF: pure steps, equal to use. One that does not repair its covariance raises DivergedError."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief through a motion, to its new stamp."""

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement of its stamp."""
