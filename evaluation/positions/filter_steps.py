"""What a filter did in a run, step by step: the motions, changes and measurements that its last belief is made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Filter, Measurement, Motion
from protocol.arrays import Bools, Floats

REMEMBERED_NS = 10_000_000_000  # a filter goes back less than that


@dataclass(frozen=True)
class LinearChange:
    """A change of the state: its error mapped by M (n, n), and noise of covariance V (n, n)."""

    M: Floats
    V: Floats


@dataclass(frozen=True)
class Step:
    """One step, and the belief after it: x (n,), variances (n,). What it was; the belief itself is the first."""

    stamp_ns: int
    x: Floats
    variances: Floats
    what: Motion | LinearChange | Measurement | Belief
    before: int | None  # number of the step before it


class StepRecorder:
    """A filter that does what another one does, and remembers it; for the belief that a run ends with."""

    def __init__(self, engine: Filter) -> None:
        self._engine = engine
        self._steps: list[Step] = []
        self._recent: dict[int, tuple[int, Belief]] = {}  # by identity: number of its step, and the belief itself

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief through a motion, to its new stamp."""
        before = self._number(belief)
        return self._noted(self._engine.predict(belief, motion, stamp_ns), motion, before)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement of its stamp; only one that was accepted is a step."""
        before = self._number(belief)
        result = self._engine.condition(belief, measurement)
        if result.accepted:
            self._noted(result.belief, measurement, before)
        return result

    def steps(self, last: Belief) -> list[Step]:
        """All steps that led to a recent belief, oldest first."""
        steps, number = [], self._recent[id(last)][0]
        while number is not None:
            steps.append(self._steps[number])
            number = steps[-1].before
        return steps[::-1]

    def _noted(self, belief: Belief, what: Motion | LinearChange | Measurement | Belief, before: int | None) -> Belief:
        self._recent[id(belief)] = len(self._steps), belief
        self._steps.append(Step(belief.stamp_ns, belief.x, belief.P.diagonal().copy(), what, before))
        if len(self._steps) % 1000 == 0:
            oldest_ns = belief.stamp_ns - REMEMBERED_NS
            self._recent = {key: value for key, value in self._recent.items() if value[1].stamp_ns >= oldest_ns}
        return belief

    def _number(self, belief: Belief) -> int:
        """Number of the step that made a belief; one that no step made comes from a change of another, or is first."""
        if id(belief) not in self._recent:
            if not self._steps:
                self._noted(belief, belief, None)
            else:
                change, before = self._change(belief)
                self._noted(belief, change, before)
        return self._recent[id(belief)][0]

    def _change(self, belief: Belief) -> tuple[LinearChange, int]:
        """How the belief was made of the newest one of its stamp that it is a change of."""
        for number, before in reversed(self._recent.values()):
            if before.stamp_ns == belief.stamp_ns and (change := linear_change(before, belief)):
                return change, number
        raise ValueError("a belief was changed in a way that cannot be followed")


def linear_change(before: Belief, after: Belief) -> LinearChange | None:
    """The change that made one belief of another: states that were reset, or opened; None where it was neither."""
    changed = (before.x != after.x) | (before.P.diagonal() != after.P.diagonal())
    if not np.array_equal(before.P[np.ix_(~changed, ~changed)], after.P[np.ix_(~changed, ~changed)]):
        return None
    M, V = np.eye(len(changed)), np.zeros_like(after.P)
    states, across = np.ix_(changed, changed), np.ix_(changed, ~changed)
    if not after.P[across].any():
        M[changed] = 0.0
        V[states] = after.P[states]
    elif np.array_equal(before.P[across], after.P[across]):
        V[states] = after.P[states] - before.P[states]
    else:
        return None
    return LinearChange(M, V)
