"""Values that are not taken at their word: pairs of them make a rate, or the first is what the filter believes then.

Both are of robot_localization (Moore & Stouch 2014: `differential`, `relative`). There a reference is exact, as the
start is zero by definition; here the filter may be unsure of it, and later learn better. So where the state has room, a
reference brings states of its own: how far off the filter was at that moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Belief
from protocol.arrays import Floats

PAIR_S = 1.1  # the mean over more says too little of its middle; a receiver of 1 Hz, with its jitter, makes pairs


@dataclass(frozen=True)
class Told:
    """Values (k,) and their variances (k,) at a stamp."""

    stamp_ns: int
    values: Floats
    variances: Floats


def rate(before: Told, now: Told, *, angles: bool = False) -> Told | None:
    """Mean rate of change between two, at the middle of their time, for which it is true to second order.

    None where they are more than PAIR_S apart, or not in order. angles: the values are [rad], and wrap.
    """
    dt_s = (now.stamp_ns - before.stamp_ns) * 1e-9
    if not 0 < dt_s <= PAIR_S:
        return None
    change = now.values - before.values
    if angles:
        change = np.remainder(change + np.pi, 2 * np.pi) - np.pi
    middle_ns = (before.stamp_ns + now.stamp_ns) // 2
    return Told(middle_ns, change / dt_s, (before.variances + now.variances) / dt_s**2)


def renewed(belief: Belief, states: slice, variance: float) -> Belief:
    """The belief with states that nothing is known of."""
    x, P = belief.x.copy(), belief.P.copy()
    x[states], P[states, :], P[:, states] = 0.0, 0.0, 0.0
    P[states, states] = np.eye(states.stop - states.start) * variance
    return Belief(belief.stamp_ns, x, P)


def referred(belief: Belief, states: slice, H: Floats, variance: float) -> Belief:
    """The belief with states (k,) for how far off it is now, in what H (k, n) sees: minus that, as it is off by.

    variance: of what else makes the reference wrong. A reading that counts from here then says nothing of now.
    """
    found = renewed(belief, states, variance)
    seen = H @ found.P
    found.P[states, states] += seen @ H.T
    others = np.ones(len(found.x), bool)
    others[states] = False
    found.P[states, others] = -seen[:, others]
    found.P[others, states] = -seen[:, others].T
    return found
