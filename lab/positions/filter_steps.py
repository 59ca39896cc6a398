"""What a filter did in a run, step by step: the motions, changes and measurements that its last belief is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Filter, Measurement, Motion
from protocol.arrays import Floats

REMEMBERED_NS = 10_000_000_000  # a filter goes back less than that


@dataclass(frozen=True)
class LinearChange:
    """A change of the state x (n,) to M x + c, with noise of covariance V (n, n)."""

    M: Floats
    c: Floats
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
        """All steps that led to a recent belief, oldest first; ValueError of a belief that it did not make."""
        if id(last) not in self._recent:
            raise ValueError("the belief is of another run")
        steps: list[Step] = []
        number: int | None = self._recent[id(last)][0]
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
    """The change that made one belief of another, of which some states stay as they are; None where none does.

    The others were opened, so that their variance alone grew, or stand anew for what the rest says of them: the
    regression on the rest, with the variance that it leaves. A reset is one on nothing.
    """
    changed = (before.x != after.x) | (before.P.diagonal() != after.P.diagonal())
    rest, n = ~changed, len(changed)
    M, c, V = np.eye(n), np.zeros(n), np.zeros((n, n))
    kept, states, across = np.ix_(rest, rest), np.ix_(changed, changed), np.ix_(changed, rest)
    if not rest.any() or not np.array_equal(before.P[kept], after.P[kept]):
        return None
    if np.array_equal(before.x, after.x) and np.array_equal(before.P[across], after.P[across]):
        V[states] = after.P[states] - before.P[states]
        return LinearChange(M, c, V)
    M[changed] = 0.0
    M[across] = np.linalg.solve(after.P[kept], after.P[across].T).T
    c[changed] = after.x[changed] - M[across].dot(after.x[rest])
    V[states] = after.P[states] - M[across].dot(after.P[across].T)
    return LinearChange(M, c, V)
