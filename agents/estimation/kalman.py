"""Rolling resistance by a Kalman filter with a random walk, a test for borders, and a smoother that looks ahead.

State: c_rr, and the scale error of drive force over mass where the mass is to be estimated. Ground changes with the
way, so the walk is per square root of a metre. A border is a jump: at every step the last ones are split in two at each
place, and where the later part is off by more than chance would have it (a generalised likelihood ratio: Basseville and
Nikiforov 1993, chapter 2), the filter is run again from there with c_rr set free, so that a border lies where it began
and not where it was noticed. What is asked for a stamp is smoothed backwards from the newest step (Rauch, Tung and
Striebel 1965), which never crosses a border.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from agents.estimation.resistance import Push
from protocol.arrays import Floats

KEPT = 100  # steps: 5 s
FIRST_C_RR, FIRST_STD = 0.03, 0.1
NEAR_NS = 150_000_000  # an estimate this far from a step that was usable is none


@dataclass(frozen=True)
class KalmanConfig:
    """noise: of one raw c_rr, as a density [1/sqrt(Hz)]. walk: random walk of c_rr [1/sqrt(m)].

    jump_sigma: how many standard deviations off a border is. jump: and at least so much. jump_std: standard deviation
    that c_rr gets there. border_steps: the least steps behind a border, and those that are searched for it.
    scale_walk: random walk of the scale error [1/sqrt(s)]. scale_std: that it gets when the load changes; only where
    the mass is estimated.
    """

    noise: float = 0.004
    walk: float = 0.002
    jump_sigma: float = 4.0
    jump: float = 0.006
    jump_std: float = 0.1
    border_steps: tuple[int, int] = (4, 40)
    scale_walk: float = 1e-3
    scale_std: float = 0.2

    def __post_init__(self) -> None:
        for name in set(self.__dataclass_fields__) - {"border_steps"}:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be positive and finite")
        least, most = self.border_steps
        if not 2 <= least < most <= KEPT:
            raise ValueError(f"border_steps: {least}, {most} are not from 2 to {KEPT} and rising")


@dataclass(slots=True)
class _Step:
    """One step: its measurement z = h x with variance r, what the state gains in variance before it, and the belief."""

    stamp_ns: int
    z: float
    h: Floats
    r: float
    q: Floats
    x: Floats
    P: Floats
    border: bool = False


class KalmanResistance:
    """The default estimator. estimates_mass: whether the scale error is a state."""

    def __init__(self, config: KalmanConfig, *, estimates_mass: bool = False) -> None:
        self._config = config
        self._estimates_mass = estimates_mass
        self._scale_var = config.scale_std**2 if estimates_mass else 0.0
        self._first = _Step(
            0, 0.0, np.zeros(2), 1.0, np.zeros(2), np.array([FIRST_C_RR, 0.0]), np.diag([FIRST_STD**2, self._scale_var])
        )
        self._steps: list[_Step] = []
        self._freed = False  # whether the load may have changed since the last step

    def update(self, push: Push) -> None:
        """Filter a step, and look for a border."""
        c = self._config
        q = np.array([c.walk**2 * push.way_m, c.scale_walk**2 * push.dt_s if self._estimates_mass else 0.0])
        if self._freed:
            q[1], self._freed = self._scale_var, False
        h = np.array([push.regressor, push.share if self._estimates_mass else 0.0])
        step = _Step(push.stamp_ns, push.raw, h, c.noise**2 / push.dt_s, q, q, q)
        self._steps.append(step)
        self._filter(len(self._steps) - 1)
        self._look_for_border()
        if len(self._steps) > 2 * KEPT:
            self._first = self._steps[KEPT - 1]
            del self._steps[:KEPT]

    def rest(self, *, changes_load: bool) -> None:
        """Free the scale error, where it is estimated, if the load may change."""
        self._freed = self._estimates_mass and changes_load

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """c_rr and its variance at a recent stamp, with what came after it."""
        index = bisect_left(self._steps, stamp_ns, key=lambda step: step.stamp_ns)
        if index == len(self._steps) or self._steps[index].stamp_ns - stamp_ns > NEAR_NS:
            index -= 1  # the step before may still be near
        if index < 0 or abs(self._steps[index].stamp_ns - stamp_ns) > NEAR_NS:
            return None
        x, P = self._smoothed(index)
        return float(x[0]), float(P[0, 0])

    def _before(self, index: int) -> _Step:
        return self._steps[index - 1] if index else self._first

    def _filter(self, index: int) -> None:
        """Filter all steps from one on; the one before it stands."""
        before = self._before(index)
        x, P = before.x, before.P
        for step in self._steps[index:]:
            P = P + np.diag(step.q)
            if step.border:
                P[0, 0] = max(P[0, 0], self._config.jump_std**2)
                P[0, 1] = P[1, 0] = 0.0
            Ph = P @ step.h
            K = Ph / (step.h @ Ph + step.r)
            x, P = x + K * (step.z - step.h @ x), P - np.outer(K, Ph)
            step.x, step.P = x, P

    def _look_for_border(self) -> None:
        """Split the last steps where the later ones fit the state before them worst, and filter them again if so."""
        c, n = self._config, len(self._steps)
        least, most = c.border_steps
        borders = [i for i in range(max(n - most, 0), n) if self._steps[i].border]
        first = (borders[-1] if borders else max(n - most, 0)) + least  # something has to be known before it
        if n - first < least:
            return
        recent = self._steps[first:]
        z, h0, r = (
            np.array(values) for values in zip(*((s.z - s.h[1] * s.x[1], s.h[0], s.r) for s in recent), strict=True)
        )
        weights = h0**2 / r
        total = np.cumsum(weights[::-1])[::-1]
        later = np.cumsum((h0 * z / r)[::-1])[::-1] / total
        before = [self._before(i) for i in range(first, n)]
        x, P = np.array([s.x[0] for s in before]), np.array([s.P[0, 0] for s in before])
        off = np.abs(later - x)[: n - first - least + 1]
        sigma = np.sqrt(P + 1 / total)[: len(off)]
        likely = np.where(off > c.jump, off / sigma, 0.0)
        best = int(likely.argmax())
        if likely[best] > c.jump_sigma:
            self._steps[first + best].border = True
            self._filter(first + best)

    def _smoothed(self, index: int) -> tuple[Floats, Floats]:
        newest = self._steps[-1]
        x, P = newest.x, newest.P
        for i in range(len(self._steps) - 2, index - 1, -1):
            here, after = self._steps[i], self._steps[i + 1]
            predicted = here.P + np.diag(after.q)
            if after.border:
                predicted[0, 0] = max(predicted[0, 0], self._config.jump_std**2)
                predicted[0, 1] = predicted[1, 0] = 0.0
                G = np.diag([0.0, here.P[1, 1] / max(predicted[1, 1], 1e-30)])
            elif self._estimates_mass:
                G = here.P @ np.linalg.inv(predicted)
            else:
                G = np.diag([here.P[0, 0] / predicted[0, 0], 0.0])
            x, P = here.x + G @ (x - here.x), here.P + G @ (P - predicted) @ G.T
        return x, P
