"""How much of their slow errors the GPS receivers of one machine share, from the differences of their fixes.

Antennas a metre apart see the same satellites through the same air; reflections are each one's own. In the difference
of two fixes, less that of their antennas by dead reckoning, the machine's place and whatever both receivers err alike
drop out. What is left of a share s, of slow variances U and V, is a Gauss-Markov process per axis, and white noise:

    difference = d + white        variance of d = U + V - 2 s min(U, V)

It lasts for half a minute, so ten minutes are worth some dozen independent values, too few for a mean square of them.
So a Kalman filter per candidate s follows d, and the likelihood of what it did not expect weighs its candidate
(multiple-model estimation, Magill 1965; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 11.6.2). All shares are equally likely at first. The mean is what the filter of positions needs,
since the variance of what receivers have in common is linear in s.
"""

import math
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Bools, Floats

CANDIDATES = (np.arange(16) + 0.5) / 16
MOST_SHARED = 0.99  # a configured share counts up to here: errors that are wholly the same have no definite covariance
MEMORY_S = 1800.0  # how long differences count: shares change with reflections, from place to place
SPAN_NS = 1_000_000_000  # fixes of a second are averaged: more of them say little about an error that lasts for minutes
GATE_SIGMA = 4.0  # a difference that not even independent receivers would show is an outlier and says nothing


@dataclass(frozen=True)
class SharedFix:
    """One fix of a receiver, and where dead reckoning has its antenna, in its own frame: (2,) each [m].

    white_m2, slow_m2: variances of its errors, per axis. time_s: correlation time of the slow one.
    """

    receiver: int
    stamp_ns: int
    position_m: Floats
    reckoned_m: tuple[float, float]
    white_m2: float
    slow_m2: float
    time_s: float


class ShareEstimator:
    """Estimates the share of the slow variance that receivers of one machine have in common."""

    def __init__(self, receivers: int) -> None:
        self._first, self._second = np.triu_indices(receivers, 1)
        pairs = len(self._first)
        self._x = np.zeros((pairs, 2, len(CANDIDATES)))  # of both axes
        self._P = np.zeros((pairs, len(CANDIDATES)))  # the same for both
        self._log = np.zeros(len(CANDIDATES))  # likelihoods
        self._sums = np.zeros((receivers, 6))  # of a span: count, fix, antenna by dead reckoning, white variance
        self._slow_m2, self._time_s = np.ones(receivers), np.ones(receivers)
        self._span = 0
        self._filtered = 0  # the last span that was
        self.share = float(CANDIDATES.mean())

    def add(self, fix: SharedFix, rotation_rad: float) -> None:
        """Take in a fix; rotation_rad: of the frame of dead reckoning in `map`, as known by now."""
        span = fix.stamp_ns // SPAN_NS
        if span < self._span:
            return  # too late
        if span > self._span:
            self._close(rotation_rad)
            self._span = span
        i = fix.receiver
        self._sums[i] += (1.0, *fix.position_m, *fix.reckoned_m, fix.white_m2)
        self._slow_m2[i], self._time_s[i] = fix.slow_m2, fix.time_s

    def _close(self, rotation_rad: float) -> None:
        """Compare what receivers said in the span that ends."""
        count = self._sums[:, 0]
        seen = (count[self._first] > 0) & (count[self._second] > 0)
        if seen.any():
            mean = self._sums[:, 1:] / np.maximum(count, 1)[:, None]
            c, s = math.cos(rotation_rad), math.sin(rotation_rad)
            off = mean[:, :2] - mean[:, 2:4] @ np.array([[c, s], [-s, c]])
            white = mean[:, 4] / np.maximum(count, 1)
            self._compare(off[self._first] - off[self._second], white[self._first] + white[self._second], seen)
        self._sums[:] = 0.0

    def _compare(self, differences: Floats, white_m2: Floats, seen: Bools) -> None:
        """Weigh the candidates by differences (p, 2) of p pairs and their white noise (p,); seen: which there are."""
        U, V, times = self._slow_m2[self._first], self._slow_m2[self._second], self._time_s
        dt_s = (self._span - self._filtered) * SPAN_NS * 1e-9
        self._filtered = self._span
        keep = np.exp(-dt_s * 2 / (times[self._first] + times[self._second]))[:, None]
        variance = (U + V)[:, None] - 2 * np.minimum(U, V)[:, None] * CANDIDATES
        self._x *= keep[:, None]
        self._P = keep**2 * self._P + (1 - keep**2) * variance
        S = self._P + white_m2[:, None]
        y = differences[:, :, None] - self._x
        squares = y**2 / S[:, None]
        used = seen & (squares[:, :, 0].max(axis=1) <= GATE_SIGMA**2)  # by the first candidate, which expects most
        gain = np.where(used[:, None], self._P / S, 0.0)
        self._x += gain[:, None] * y
        self._P -= gain * self._P
        likelihood = -np.log(S) - 0.5 * np.minimum(squares, GATE_SIGMA**2).sum(axis=1)
        # g receivers have g (g - 1) / 2 pairs, but only g - 1 differences that are independent
        weight = 2 / np.count_nonzero(self._sums[:, 0])
        self._log = math.exp(-dt_s / MEMORY_S) * self._log + weight * likelihood[used].sum(axis=0)
        weights = np.exp(self._log - self._log.max())
        self.share = float(weights.dot(CANDIDATES) / weights.sum())
