"""Rolling resistance by a Kalman filter with a random walk, a test for borders, and a smoother that looks ahead.

State: c_rr under the leading axle and under the trailing one, and the scale error of drive force over mass where the
mass is to be estimated. Both axles stand on the same ground until the leading one crosses a border; from there on the
balance weighs two grounds by the axles' loads, until the trailing one has come up. Ground changes with the way, so the
walk is per square root of a metre.

A border is a jump: at every step the last ones are split in two at each place, and where a jump there, seen first by
the leading axle, explains the later part far better (a generalised likelihood ratio: Basseville and Nikiforov 1993,
chapter 2), the filter is run again from there with the leading c_rr set free, so that a border lies where it is and not
where it was noticed. What is asked for a stamp is smoothed backwards from the newest step (Rauch, Tung and Striebel
1965), which never crosses a border.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from agents.estimation.resistance import Push
from protocol.arrays import Floats
from protocol.config import require_positive

KEPT = 100  # steps: 5 s
FIRST_C_RR, FIRST_STD = 0.03, 0.1
NOISE_S = 20.0  # over which noise is measured
OUTLIER = 16.0  # squares beyond so many times the mean are something else
NEAR_NS = 150_000_000  # an estimate this far from a step that was usable is none
EYE = np.eye(3)
# What of the state survives: both axles stand where the leading one does; or nothing is known under the leading one.
MERGED = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FREED = np.diag([0.0, 1.0, 1.0])
TINY = 1e-14 * EYE  # both axles on the same ground: a covariance without inverse


@dataclass(frozen=True)
class KalmanConfig:
    """How c_rr is filtered.

    noise: of one raw c_rr, at least, as a density [1/sqrt(Hz)]; what successive ones differ by shows it. walk: random
    walk of c_rr [1/sqrt(m)]. jump_sigma: how many standard deviations off a border is. jump: and at least so much.
    jump_std: standard deviation that c_rr gets there. border_steps: the least steps behind a border, and those that
    are searched for it. scale_walk: random walk of the scale error [1/sqrt(s)]. scale_std: that it gets when the load
    changes; only where the mass is estimated.
    """

    noise: float = 0.004
    walk: float = 0.002
    jump_sigma: float = 5.5
    jump: float = 0.006
    jump_std: float = 0.1
    border_steps: tuple[int, int] = (4, 40)
    scale_walk: float = 1e-3
    scale_std: float = 0.2

    def __post_init__(self) -> None:
        require_positive(self, set(self.__dataclass_fields__) - {"border_steps"})
        least, most = self.border_steps
        if not 2 <= least < most <= KEPT:
            raise ValueError(f"border_steps: {least}, {most} are not from 2 to {KEPT} and rising")


@dataclass(slots=True)
class _Step:
    """One step: its push with h and variance r of the measurement, and what the filter made of it.

    way_m: driven so far. border: whether the leading axle crossed one before it. begun_m: where the crossing that is
    under way began, NaN if none is. A: what of the state before survives (3, 3); x0, P0: belief before the measurement,
    x, P: after it.
    """

    push: Push
    way_m: float
    h: Floats
    r: float
    scale_var: float
    border: bool = False
    begun_m: float = math.nan
    A: Floats = field(init=False)
    x0: Floats = field(init=False)
    P0: Floats = field(init=False)
    x: Floats = field(init=False)
    P: Floats = field(init=False)

    @property
    def is_plain(self) -> bool:
        """Whether both axles stood on the same ground, and still do."""
        return self.A is EYE and math.isnan(self.begun_m)


class KalmanResistance:
    """The default estimator. estimates_mass: whether the scale error is a state."""

    def __init__(self, config: KalmanConfig, *, estimates_mass: bool = False) -> None:
        self._config = config
        self._estimates_mass = estimates_mass
        scale_var = config.scale_std**2 if estimates_mass else 0.0
        first = Push(0, 0.0, 0.0, 0.0, 1.0, 0.0)
        P = _tied(FIRST_STD**2)
        P[2, 2] = scale_var
        self._first = _Step(first, 0.0, np.zeros(3), 1.0, 0.0)
        self._first.x, self._first.P = np.array([FIRST_C_RR, FIRST_C_RR, 0.0]), P
        self._steps: list[_Step] = []
        self._density = config.noise**2  # of the noise [1/Hz]
        self._last: Push | None = None
        self._freed = False  # whether the load may have changed since the last step

    def update(self, push: Push) -> None:
        """Filter a step, and look for a border."""
        c = self._config
        self._listen(push)
        scale_var = c.scale_walk**2 * push.dt_s if self._estimates_mass else 0.0
        if self._freed:
            scale_var, self._freed = c.scale_std**2, False
        lead, share = push.lead_share, push.share if self._estimates_mass else 0.0
        h = np.array([push.regressor * lead, push.regressor * (1 - lead), share])
        way_m = self._before(len(self._steps)).way_m + push.way_m
        self._steps.append(_Step(push, way_m, h, self._density / push.dt_s, scale_var))
        self._filter(len(self._steps) - 1)
        self._look_for_border()
        if len(self._steps) > 2 * KEPT:
            self._first = self._steps[KEPT - 1]
            del self._steps[:KEPT]

    def rest(self, *, changes_load: bool) -> None:
        """Free the scale error, where it is estimated, if the load may change."""
        self._freed = self._freed or (self._estimates_mass and changes_load)

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """c_rr and its variance under the load centre at a recent stamp, with what came after it."""
        index = bisect_left(self._steps, stamp_ns, key=lambda step: step.push.stamp_ns)
        if index == len(self._steps) or self._steps[index].push.stamp_ns - stamp_ns > NEAR_NS:
            index -= 1  # the step before may still be near
        if index < 0 or abs(self._steps[index].push.stamp_ns - stamp_ns) > NEAR_NS:
            return None
        step = self._steps[index]
        x, P = self._smoothed(index)
        axle = int(step.way_m - step.begun_m < step.push.lead_m)  # 0 where no crossing is under way
        return float(x[axle]), float(P[axle, axle])

    def _listen(self, push: Push) -> None:
        """Measure the noise: half the mean square of what successive steps differ by, without the ground's part."""
        last, self._last = self._last, push
        if last is None or last.regressor * push.regressor < 0 or push.stamp_ns - last.stamp_ns > NEAR_NS:
            return
        found = 0.5 * (push.raw - last.raw) ** 2 * push.dt_s
        found = min(found, OUTLIER * self._density)
        share = min(push.dt_s / NOISE_S, 1.0)
        self._density = max(self._density + share * (found - self._density), self._config.noise**2)

    def _before(self, index: int) -> _Step:
        return self._steps[index - 1] if index else self._first

    def _filter(self, index: int) -> None:
        """Filter all steps from one on; the one before it stands."""
        before = self._before(index)
        for step in self._steps[index:]:
            self._predict(before, step)
            x, P = step.x0, step.P0
            Ph = P @ step.h
            K = Ph / (step.h @ Ph + step.r)
            step.x, step.P = x + K * (step.push.raw - step.h @ x), P - np.outer(K, Ph)
            before = step

    def _predict(self, before: _Step, step: _Step) -> None:
        """Belief before the measurement of a step, from that of the step before."""
        c, push = self._config, step.push
        walk = c.walk**2 * push.way_m
        turned = before.push.regressor * push.regressor < 0
        begun_m = step.way_m if step.border else before.begun_m
        step.A, free = EYE, 0.0
        if turned and not math.isnan(begun_m):  # back across a border half crossed: what was leading trails now
            step.A, begun_m, free = MERGED, math.nan, c.jump_std**2
        elif step.border:
            step.A, free = FREED, c.jump_std**2
        if step.way_m - begun_m >= push.wheelbase_m:  # the trailing axle has come up
            step.A, begun_m = (MERGED @ step.A if push.wheelbase_m else MERGED * [0, 0, 1]), math.nan
        step.begun_m = begun_m
        Q = _tied(walk + free) if math.isnan(begun_m) else np.diag([walk + free, 0.0, 0.0])
        Q[2, 2] = step.scale_var
        step.x0 = (MERGED if math.isnan(begun_m) else EYE) @ before.x
        step.P0 = step.A @ before.P @ step.A.T + Q

    def _look_for_border(self) -> None:
        """Try a jump at each of the last steps on those that follow, and filter again from the likeliest, if it is."""
        c, n = self._config, len(self._steps)
        least, most = c.border_steps
        first = max(n - most, 0)
        self._doubt(n - 2 * least)
        for i in range(n - 1, first - 1, -1):
            if self._steps[i].border or not math.isnan(self._steps[i].begun_m):  # one border at a time
                first = i + 1
                break
        first += least  # something has to be known before it
        if n - first < least:
            return
        recent = self._steps[first:]
        z, h, r, way, lead, base = np.array(
            [
                (s.push.raw - s.h[2] * s.x[2], s.push.regressor, s.r, s.way_m, s.push.lead_share, s.push.wheelbase_m)
                for s in recent
            ]
        ).T
        before = [self._before(i) for i in range(first, n)]
        x, P = np.array([(s.x[0], s.P[0, 0]) for s in before]).T
        # Row i: a jump before step i, and the share of it that each step would show.
        shows = np.triu(np.where(way - way[:, None] < base, lead, 1.0)) * h
        weight = shows / r
        total = (weight * shows).sum(axis=1)
        jump = (weight @ z - (weight @ h) * x) / total
        sigma = np.sqrt(1 / total + P * (weight @ h / total) ** 2)
        likely = np.where(np.abs(jump) > c.jump, np.abs(jump) / sigma, 0.0)[: n - first - least + 1]
        best = int(likely.argmax())
        if likely[best] > c.jump_sigma:
            self._steps[first + best].border = True
            self._filter(first + best)

    def _doubt(self, since: int) -> None:
        """Take back a border that is younger than this step: with more behind it, it may lie elsewhere."""
        for i in range(len(self._steps) - 1, max(since, 0) - 1, -1):
            if self._steps[i].border:
                self._steps[i].border = False
                self._filter(i)

    def _smoothed(self, index: int) -> tuple[Floats, Floats]:
        newest = self._steps[-1]
        x, P = newest.x, newest.P
        for i in range(len(self._steps) - 2, index - 1, -1):
            here, after = self._steps[i], self._steps[i + 1]
            if after.is_plain and not self._estimates_mass:  # both axles on one ground: a number, most of the time
                g = float(here.P[0, 0]) / float(after.P0[0, 0])
                x = here.x + g * (x - after.x0)
                P = here.P + g**2 * (P - after.P0)
                continue
            G = np.linalg.solve(after.P0 + TINY, after.A @ here.P).T
            x, P = here.x + G @ (x - after.x0), here.P + G @ (P - after.P0) @ G.T
        return x, P


def _tied(variance: float) -> Floats:
    """Covariance (3, 3) of two axles on the same ground."""
    return np.array([[variance, variance, 0.0], [variance, variance, 0.0], [0.0, 0.0, 0.0]])
