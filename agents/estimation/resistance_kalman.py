"""Rolling resistance by a Kalman filter with a random walk that stops at borders, and a smoother.

State x = (c_lead, c_trail, e): c_rr under leading and trailing axle, and scale error of drive force over mass, if mass
is estimated. With w the leading axle's load share, a step measures

    raw = h x + noise        h = (regressor w, regressor (1 - w), share)

While the axles cross a border the balance weighs two grounds, else one. The random walk is per square root of a metre.
x, P before; x0, P0 and x1, P1 at this step; T for transpose:

    predict   x0 = x, c_trail = c_lead on one ground    P0 = A P A^T + Q
    correct   K = P0 h^T / (h P0 h^T + r)               x1 = x0 + K (raw - h x0)    P1 = P0 - K h P0
    smooth    G = P A^T P0^-1                           xs = x + G (xs1 - x0)       Ps = P + G (Ps1 - P0) G^T

(Rauch, Tung and Striebel 1965). A is the identity on one ground. At a border it forgets the leading axle's c_rr; after
the crossing the trailing axle inherits it. `borders` locates borders anew at every step, and the filter reruns from the
first change: a border lies where it is, not where it was noticed. The smoother never crosses one.
"""

import math
from bisect import bisect_left
from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from agents.estimation.balance import BalanceStep
from agents.estimation.borders import BorderSearch
from agents.estimation.tuning import TUNING, EstimationTuning
from protocol.arrays import Floats

LEAD, TRAIL, SCALE = 0, 1, 2
KEPT = 100  # steps, 5 s: longer than samples wait for later ones
NEAR_NS = 150_000_000  # greatest distance of a stamp from a usable step
PAUSE_S = 0.1  # gap that separates steps
STEADY_S = 1.0  # time over which stepped torque has one error, and counts once

IDENTITY = np.eye(3)
TRAIL_IS_LEAD = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
LEAD_UNKNOWN = np.diag([0.0, 1.0, 1.0])
TINY = 1e-14 * np.eye(3)  # regularises a singular covariance on one ground


class _Measured(NamedTuple):
    """A measured step: total distance_m, h (3,), variance r, and process noise of the scale error."""

    step: BalanceStep
    distance_m: float
    h: Floats
    r: float
    scale_var: float


class _Filtered(NamedTuple):
    """A filtered step.

    border: crossed by the leading axle before it. crossing_m: start of the current crossing, else NaN. A: transition
    (3, 3); x0, P0: belief before, x, P: after the measurement.
    """

    measured: _Measured
    border: bool
    crossing_m: float
    A: Floats
    x0: Floats
    P0: Floats
    x: Floats
    P: Floats

    @property
    def is_crossing(self) -> bool:
        return not math.isnan(self.crossing_m)

    @property
    def is_plain(self) -> bool:
        """Whether both axles stood and stand on one ground."""
        return self.A is IDENTITY and not self.is_crossing


class KalmanResistance:
    """The default estimator. estimates_mass: whether the scale error is a state."""

    def __init__(self, *, estimates_mass: bool = False, tuning: EstimationTuning = TUNING) -> None:
        self._estimates_mass, self._tuning = estimates_mass, tuning
        self._steps: list[_Filtered] = []
        self._first = _start(tuning, tuning.load_std**2 if estimates_mass else 0.0)  # the last step that was dropped
        self._noise = _Noise(tuning)
        self._search = BorderSearch(2 * KEPT + 1, tuning)
        self._count = 0  # of all steps
        self._load_has_changed = False

    @property
    def scale(self) -> float:
        """Scale error of drive force over mass [-]; 0 if not estimated."""
        return float(self._before(len(self._steps)).x[SCALE])

    def update(self, step: BalanceStep) -> None:
        """Filter a step, and search for borders."""
        self._noise.update(step)
        scale_var = self._tuning.scale_walk**2 * step.dt_s if self._estimates_mass else 0.0
        if self._load_has_changed:
            scale_var, self._load_has_changed = self._tuning.load_std**2, False
        lead, share = step.lead_share, step.share if self._estimates_mass else 0.0
        h = np.array([step.regressor * lead, step.regressor * (1 - lead), share])
        before = self._before(len(self._steps))
        distance_m = before.measured.distance_m + step.distance_m
        density = self._noise.density + step.share_var * STEADY_S
        measured = _Measured(step, distance_m, h, density / step.dt_s, scale_var)
        self._steps.append(_filtered(before, measured, self._tuning, border=False))
        self._count += 1
        raw = step.raw - share * float(before.x[SCALE])
        self._set_borders(self._search.update(self._count, step, raw, measured.r))
        if len(self._steps) > 2 * KEPT:
            self._first = self._steps[KEPT - 1]
            del self._steps[:KEPT]

    def stand(self, *, changes_load: bool) -> None:
        """Release the scale error if the load may change."""
        self._load_has_changed = self._load_has_changed or (self._estimates_mass and changes_load)

    def recalibrate(self, zero: float, scale: float) -> None:
        """Filter all steps again with a changed calibration, so that the ground does not seem to change."""
        believed = float(self._before(len(self._steps)).x[LEAD])
        first = self._first.measured.step
        shift = (zero + scale * first.share) / first.regressor
        x = self._first.x - shift * np.array([1.0, 1.0, 0.0])
        self._first = self._first._replace(x=x)
        self._noise.interrupt()
        for i, old in enumerate(self._steps):
            step = old.measured.step
            step = replace(step, raw=step.raw - zero - scale * step.share)
            self._steps[i] = _filtered(
                self._before(i), old.measured._replace(step=step), self._tuning, border=old.border
            )
        # A bias counts with opposite signs ahead and in reverse; the filter knows the net effect.
        self._search.shift(float(self._before(len(self._steps)).x[LEAD]) - believed)

    def at(self, stamp_ns: int) -> tuple[float, float] | None:
        """Smoothed c_rr and variance under the load centre at a recent stamp."""
        index = bisect_left(self._steps, stamp_ns, key=lambda filtered: filtered.measured.step.stamp_ns)
        if index == len(self._steps) or self._stamp_ns(index) - stamp_ns > NEAR_NS:
            index -= 1  # the step before may be nearer
        if index < 0 or abs(self._stamp_ns(index) - stamp_ns) > NEAR_NS:
            return None
        filtered = self._steps[index]
        x, P = self._smoothed(index)
        since_border_m = filtered.measured.distance_m - filtered.crossing_m  # NaN without a crossing
        axle = TRAIL if since_border_m < filtered.measured.step.lead_m else LEAD
        return float(x[axle]), float(P[axle, axle])

    def _stamp_ns(self, index: int) -> int:
        return self._steps[index].measured.step.stamp_ns

    def _before(self, index: int) -> _Filtered:
        return self._steps[index - 1] if index else self._first

    def _set_borders(self, numbers: Collection[int]) -> None:
        first = self._count - len(self._steps) + 1
        borders = [number in numbers for number in range(first, self._count + 1)]
        changed = next((i for i, old in enumerate(self._steps) if old.border != borders[i]), len(borders))
        for i in range(changed, len(borders)):
            self._steps[i] = _filtered(self._before(i), self._steps[i].measured, self._tuning, border=borders[i])

    def _smoothed(self, index: int) -> tuple[Floats, Floats]:
        newest = self._steps[-1]
        x, P = newest.x, newest.P
        for i in range(len(self._steps) - 2, index - 1, -1):
            here, after = self._steps[i], self._steps[i + 1]
            if after.is_plain and not self._estimates_mass:  # scalar in the usual case, both axles on one ground
                g = float(here.P[0, 0]) / float(after.P0[0, 0])
                x = here.x + g * (x - after.x0)
                P = here.P + g**2 * (P - after.P0)
                continue
            G = np.linalg.solve(after.P0 + TINY, after.A @ here.P).T
            x, P = here.x + G @ (x - after.x0), here.P + G @ (P - after.P0) @ G.T
        return x, P


class _Noise:
    """Noise density of raw c_rr [1/Hz]: half the mean squared difference of successive steps.

    The ground contributes little to it; a border is an outlier.
    """

    def __init__(self, tuning: EstimationTuning) -> None:
        self.density, self._tuning = tuning.noise**2, tuning
        self._last: BalanceStep | None = None

    def interrupt(self) -> None:
        self._last = None

    def update(self, step: BalanceStep) -> None:
        last, self._last = self._last, step
        if last is None or last.regressor * step.regressor < 0 or _pause_s(last, step) > PAUSE_S:
            return
        measured = min(0.5 * (step.raw - last.raw) ** 2 * step.dt_s, self._tuning.outlier * self.density)
        share = min(step.dt_s / self._tuning.noise_s, 1.0)
        self.density = max(self.density + share * (measured - self.density), self._tuning.noise**2)


def _pause_s(last: BalanceStep, step: BalanceStep) -> float:
    return (step.stamp_ns - last.stamp_ns) * 1e-9 - step.dt_s


def _start(tuning: EstimationTuning, scale_var: float) -> _Filtered:
    x, P = np.array([tuning.first_c_rr, tuning.first_c_rr, 0.0]), _same_ground(tuning.unknown_std**2)
    P[SCALE, SCALE] = scale_var
    measured = _Measured(BalanceStep(0, 0.0, 0.0, 0.0, 1.0, 0.0), 0.0, np.zeros(3), 1.0, 0.0)
    return _Filtered(measured, False, math.nan, IDENTITY, x, P, x, P)


def _filtered(before: _Filtered, measured: _Measured, tuning: EstimationTuning, *, border: bool) -> _Filtered:
    step = measured.step
    middle_m = measured.distance_m - step.distance_m / 2  # a step shows the ground at its middle
    crossing_m = middle_m if border else before.crossing_m
    A, free = IDENTITY, 0.0
    if before.is_crossing and before.measured.step.regressor * step.regressor < 0:
        # Back across a border that only one axle had crossed: leading and trailing axle swap.
        A, crossing_m, free = TRAIL_IS_LEAD, math.nan, tuning.unknown_std**2
    elif border:
        A, free = LEAD_UNKNOWN, tuning.unknown_std**2
    if measured.distance_m - crossing_m >= step.wheelbase_m:  # the trailing axle has arrived
        A, crossing_m = (TRAIL_IS_LEAD @ A if step.wheelbase_m else TRAIL_IS_LEAD * [0, 0, 1]), math.nan
    on_one_ground = math.isnan(crossing_m)
    walk = tuning.walk**2 * step.distance_m
    Q = _same_ground(walk + free) if on_one_ground else np.diag([walk + free, 0.0, 0.0])
    Q[SCALE, SCALE] = measured.scale_var
    x0 = (TRAIL_IS_LEAD if on_one_ground else IDENTITY) @ before.x
    P0 = (before.P if A is IDENTITY else A @ before.P @ A.T) + Q
    Ph = P0 @ measured.h
    K = Ph / (measured.h @ Ph + measured.r)
    x, P = x0 + K * (step.raw - measured.h @ x0), P0 - K[:, None] * Ph
    return _Filtered(measured, border, crossing_m, A, x0, P0, x, P)


def _same_ground(variance: float) -> Floats:
    """Covariance (3, 3) of two axles on one ground."""
    return np.array([[variance, variance, 0.0], [variance, variance, 0.0], [0.0, 0.0, 0.0]])
