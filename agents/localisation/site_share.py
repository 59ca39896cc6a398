"""How much of a machine's GPS error a base station has too, from the fixes of both.

Sites differ, receivers too, and a base that fails may publish anything; so nobody configures the share. Both errors
are stationary Gauss-Markov processes, whose common part has the share s of the smaller one's variance. A small Kalman
filter per candidate s follows, per axis,

    q+ = q + walk            error of dead reckoning [m]          fix less dead reckoning   z = q + e + white noise
    e+ = a e + noise         slow error of the machine            error of the base         z = b + d + white noise
    b+ = a b + noise         slow error of the base               cov(noise of e, noise of b) by s
    d+ = d                   lasting error of the base

and the likelihood of what it did not expect weighs its candidate, as in `shared_errors`. Dead reckoning knows little
after a few minutes, but it is nearly free of GPS errors: the main filter's position has taken in already what is to be
judged here.
"""

import math

import numpy as np

from agents.localisation.filters.motion import GpsError
from protocol.arrays import Floats
from protocol.machine.readings import Correction

CANDIDATES = np.array([0.0, 0.25, 0.5, 0.7, 0.85, 0.93, 0.98])
NONE_AT_FIRST = 0.5  # probability of no common part before anything is known: a base has to earn its weight
MEMORY_S = 300.0  # how long what was seen counts: a base that goes wrong must lose its weight
SPAN_NS = 1_000_000_000  # fixes and corrections of a second are averaged
RECKONED_M2_PER_M = 0.09**2  # variance that dead reckoning gains per metre driven
UNKNOWN_M2 = 10.0**2  # of q and d at first
SILENT_NS = 10_000_000_000  # a receiver without fixes for so long makes room for another
GATE_SIGMA = 5.0  # corrections further off under every candidate tell nothing of a share,
RELOCK = 10  # and after so many spans of them in a row the base counts as another one
Q, E, B, D = range(4)
OF_FIX, OF_BASE = np.array([1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
AXES = 2


class _Mean:
    """Mean of the values (2,) [m] of a span, and the variance of its white noise."""

    def __init__(self) -> None:
        self.count, self._sum_m, self._white_m2 = 0, np.zeros(AXES), 0.0

    def add(self, value_m: Floats, white_m2: float) -> None:
        self.count += 1
        self._sum_m += value_m
        self._white_m2 += white_m2

    @property
    def value_m(self) -> Floats:
        return self._sum_m / self.count

    @property
    def white_m2(self) -> float:
        return self._white_m2 / self.count**2


class SiteShareEstimator:
    """Estimates how much of their slow errors one machine and one base share; of the machine, one receiver speaks."""

    def __init__(self) -> None:
        others = len(CANDIDATES) - 1
        self._at_first = np.log([NONE_AT_FIRST, *[(1 - NONE_AT_FIRST) / others] * others])
        self._log = self._at_first.copy()
        self._x = np.zeros((len(CANDIDATES), AXES, 4))
        self._P = np.zeros((len(CANDIDATES), 4, 4))  # the same for both axes
        self._machine, self._base = GpsError(1.0, 45.0), GpsError(1.0, 45.0)
        self._receiver, self._heard_ns = "", 0
        self._driven_m = 0.0
        self._refused = 0
        self._span = self._filtered = 0
        self._fixes, self._corrections = _Mean(), _Mean()

    @property
    def share(self) -> float:
        """Mean over the candidates, 0 to 1."""
        weights = np.exp(self._log - self._log.max())
        return float(weights.dot(CANDIDATES) / weights.sum())

    def drive(self, distance_m: float) -> None:
        """Note a distance driven: dead reckoning loses its place with it."""
        self._driven_m += distance_m

    def add_fix(self, receiver: str, stamp_ns: int, off_m: Floats, white_m2: float, error: GpsError) -> None:
        """Take in what a fix is off from the antenna by dead reckoning (2,)."""
        if self._receiver not in (receiver, "") and stamp_ns - self._heard_ns < SILENT_NS:
            return
        self._reach(stamp_ns)
        if self._receiver != receiver:  # another slow error: it counts from anywhere
            self._receiver, self._driven_m = receiver, UNKNOWN_M2 / RECKONED_M2_PER_M
        self._heard_ns = stamp_ns
        self._machine = error
        self._fixes.add(off_m, white_m2)

    def add_correction(self, stamp_ns: int, off_m: Floats, correction: Correction) -> None:
        """Take in what the base is off (2,), at the stamp when that is due."""
        self._reach(stamp_ns)
        self._base = GpsError(correction.slow_m2, correction.time_s)
        self._corrections.add(off_m, correction.white_m2)

    def _reach(self, stamp_ns: int) -> None:
        """Filter the span before, if this stamp begins a new one."""
        span = stamp_ns // SPAN_NS
        if span <= self._span:
            return
        if self._fixes.count or self._corrections.count:
            self._filter()
        self._span, self._fixes, self._corrections = span, _Mean(), _Mean()

    def _filter(self) -> None:
        if not self._filtered:
            self._P[:] = np.diag([UNKNOWN_M2, self._machine.variance_m2, self._base.variance_m2, UNKNOWN_M2])
            self._filtered = self._span
        dt_s, self._filtered = (self._span - self._filtered) * SPAN_NS * 1e-9, self._span
        self._predict(dt_s)
        keep = math.exp(-dt_s / MEMORY_S)
        self._log = keep * self._log + (1 - keep) * self._at_first
        if self._fixes.count:
            self._log += self._condition(OF_FIX, self._fixes)[0]
        if self._corrections.count:
            self._log += self._condition_on_correction()
        self._log -= self._log.max()

    def _predict(self, dt_s: float) -> None:
        machine, base = self._machine, self._base
        fade = np.array([1.0, math.exp(-dt_s / machine.time_s), math.exp(-dt_s / base.time_s), 1.0])
        self._x *= fade
        self._P *= np.outer(fade, fade)
        self._P[:, Q, Q] += RECKONED_M2_PER_M * self._driven_m
        self._driven_m = 0.0
        self._P[:, E, E] += machine.variance_m2 * (1 - fade[E] ** 2)
        self._P[:, B, B] += base.variance_m2 * (1 - fade[B] ** 2)
        common = CANDIDATES * min(machine.variance_m2, base.variance_m2) * (1 - fade[E] * fade[B])
        # one noise, answered with two correlation times
        common *= 2 * math.sqrt(machine.time_s * base.time_s) / (machine.time_s + base.time_s)
        self._P[:, E, B] += common
        self._P[:, B, E] += common

    def _condition_on_correction(self) -> Floats:
        """Log-likelihood of a correction; none of one that no candidate can explain: the base jumped, or was moved."""
        before = self._x.copy(), self._P.copy()
        likelihood, nis = self._condition(OF_BASE, self._corrections)
        if nis.min() <= AXES * GATE_SIGMA**2:
            self._refused = 0
            return likelihood
        self._x, self._P = before
        self._refused += 1
        if self._refused >= RELOCK:
            self._refused = 0
            self._P[:, D, D] += UNKNOWN_M2
        return np.zeros(len(CANDIDATES))

    def _condition(self, h: Floats, mean: _Mean) -> tuple[Floats, Floats]:
        """Condition all candidates; returns log-likelihood and normalised innovation squared of each (n,)."""
        Ph = self._P @ h
        S = Ph @ h + mean.white_m2
        y = mean.value_m - self._x @ h
        self._x += y[:, :, None] * (Ph / S[:, None])[:, None, :]
        self._P -= Ph[:, :, None] * Ph[:, None, :] / S[:, None, None]
        nis = (y**2).sum(axis=1) / S
        return -np.log(S) - nis / 2, nis
