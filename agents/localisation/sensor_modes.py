"""Differential and relative sensors (Moore & Stouch 2014, robot_localization: `differential`, `relative`).

Differential: two successive values make a rate of change. Relative: the first value stands for what the filter
believes at that moment, its anchor; later values count from there. In robot_localization the anchor is exact, as the
start is zero by definition. Here the filter may be unsure of it and learn better later, so where the state has room an
anchor gets states of its own: how far off the filter was at that moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Measurement
from protocol.arrays import Floats
from protocol.rotations import wrap_angle

PAIR_S = 1.1  # a mean over more is far from the rate at its middle; a receiver of 1 Hz still makes pairs


class Stamped(Protocol):
    """What was measured at a stamp."""

    @property
    def stamp_ns(self) -> int:
        """When it was measured."""
        ...


Value = TypeVar("Value", bound=Stamped, contravariant=True)


class ModalSensors(Protocol[Value]):
    """Sensors whose values become measurements of their own stamp, each in its mode."""

    def needs_anchor(self, value: Value) -> bool:
        """Whether the measurement of this value needs to know what the filter believes at its stamp."""
        ...

    def anchor(self, value: Value, belief: Belief) -> None:
        """Let a relative sensor count from this value on, and from the belief at its stamp."""
        ...

    def measurement(self, value: Value) -> Measurement | None:
        """What the filter gets of this value; None where there is no measurement in it."""
        ...

    def confirm(self, value: Value, result: Conditioned) -> None:
        """Note that the filter had room for the measurement of this value, and what it made of it."""
        ...


@dataclass(frozen=True)
class StampedValue:
    """Values (k,) of a sensor and their variances (k,) at a stamp."""

    stamp_ns: int
    values: Floats
    variances: Floats


def rate_between(before: StampedValue, now: StampedValue, *, angles: bool = False) -> StampedValue | None:
    """Mean rate of change between two values, at the middle of their time, where it is right to second order.

    None where they are more than PAIR_S apart, or not in order. angles: the values are angles [rad].
    """
    dt_s = (now.stamp_ns - before.stamp_ns) * 1e-9
    if not 0 < dt_s <= PAIR_S:
        return None
    change = now.values - before.values
    if angles:
        change = wrap_angle(change)
    middle_ns = (before.stamp_ns + now.stamp_ns) // 2
    return StampedValue(middle_ns, change / dt_s, (before.variances + now.variances) / dt_s**2)


def reset_states(belief: Belief, states: slice, variance: float) -> Belief:
    """The belief with these states at zero, of this variance and correlated with nothing."""
    x, P = belief.x.copy(), belief.P.copy()
    x[states], P[states, :], P[:, states] = 0.0, 0.0, 0.0
    P[states, states] = np.eye(states.stop - states.start) * variance
    return Belief(belief.stamp_ns, x, P)


def anchor_states(belief: Belief, states: slice, H: Floats, variance: float) -> Belief:
    """The belief with states e (k,) for the error of an anchor: e = -H (x_true - x) + v.

    H (k, n): Jacobian of what is anchored. variance: of v, whatever else makes the anchor wrong. A value that counts
    from the anchor measures H x + e, which is independent of x at this moment.
    """
    anchored = reset_states(belief, states, variance)
    seen = H @ anchored.P
    anchored.P[states, states] += seen @ H.T
    others = np.ones(len(anchored.x), bool)
    others[states] = False
    anchored.P[states, others] = -seen[:, others]
    anchored.P[others, states] = -seen[:, others].T
    return anchored
