"""How much of their slow errors the GPS receivers of one machine share, from the differences of their fixes.

Antennas a metre apart see the same satellites through the same air; reflections are each one's own. In the difference
of two fixes, less that of their antennas by dead reckoning, the machine's place and whatever both receivers err alike
drop out. What is left of a share s, of slow variances U and V, is a Gauss-Markov process per axis, and white noise:

    difference = d + white        variance of d = U + V - 2 s min(U, V)

It lasts for half a minute, so ten minutes are worth some dozen independent values, too few for a mean square of them.
So a Kalman filter per candidate s follows d, and the likelihood of what it did not expect weighs its candidate
(multiple-model estimation, Magill 1965; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 11.6.2). The mean is what the filter of positions needs, since the variance of what receivers have
in common is linear in s. Receivers that err less than they state share the rest for all one knows: the safe side.
"""

import math
from dataclasses import dataclass

import numpy as np

from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats, Ints

CANDIDATES = np.concatenate([[0.0], (np.arange(16) + 0.5) / 16])
# Before any fix: as likely nothing as something, whatever it is (Jeffreys 1961, Theory of Probability, 5.0). Receivers
# without corrections share nearly all, with a reference station's about half, amid reflections less
# (docs/how-the-map-comes-about.md, measured facts)
PRIOR = np.array([0.5] + [0.5 / 16] * 16)
MOST_SHARED = 0.99  # a configured share counts up to here: errors that are wholly the same have no definite covariance
SPAN_NS = 1_000_000_000  # fixes of a second are averaged


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
    """Estimates the share of the slow variance that receivers of one machine have in common: `share`, by now."""

    def __init__(self, receivers: int, tuning: LocalisationTuning = TUNING) -> None:
        self.share, self._tuning = float(PRIOR.dot(CANDIDATES)), tuning
        self._first, self._second = np.triu_indices(receivers, 1)  # of p pairs
        self._x = np.zeros((len(self._first), 2, len(CANDIDATES)))  # d of both axes
        self._P = np.zeros((len(self._first), len(CANDIDATES)))  # the same for both
        self._compared = np.full(len(self._first), -np.inf)  # when they were [s]
        self._log, self._judged_s = np.zeros(len(CANDIDATES)), 0.0  # likelihoods, and when they were changed
        self._slow_m2, self._time_s = np.ones(receivers), np.ones(receivers)
        self._span = 0  # its number, and of its fixes: count, sums of fix, antenna by dead reckoning, white variance
        self._sums = np.zeros((receivers, 6))

    def add(self, fix: SharedFix, rotation_rad: float) -> None:
        """Take in a fix; rotation_rad: of the frame of dead reckoning in `map`, as known by now."""
        span = fix.stamp_ns // SPAN_NS
        if span < self._span:
            return  # too late
        if span > self._span:
            self._compare(rotation_rad)
            self._span = span
            self._sums[:] = 0.0
        i = fix.receiver
        self._sums[i] += (1.0, *fix.position_m, *fix.reckoned_m, fix.white_m2)
        self._slow_m2[i], self._time_s[i] = fix.slow_m2, fix.time_s

    def _compare(self, rotation_rad: float) -> None:
        """Compare the pairs that are due and have fixes in the span that ends."""
        count, now_s = self._sums[:, 0], self._span * SPAN_NS * 1e-9
        seen = (count > 0)[self._first] & (count > 0)[self._second]
        due = np.flatnonzero(seen & (now_s - self._compared >= self._tuning.compared_s))
        if not due.size:
            return
        mean = self._sums[:, 1:] / np.maximum(count, 1.0)[:, None]
        c, s = math.cos(rotation_rad), math.sin(rotation_rad)
        off = mean[:, :2] - mean[:, 2:4].dot([[c, s], [-s, c]])
        white = mean[:, 4] / np.maximum(count, 1.0)
        i, j = self._first[due], self._second[due]
        keep = np.exp(2 * (self._compared[due] - now_s) / (self._time_s[i] + self._time_s[j]))
        self._compared[due] = now_s
        likelihood = self._filter(due, off[i] - off[j], white[i] + white[j], keep)
        # g receivers have g (g - 1) / 2 pairs, but only g - 1 differences that are independent
        self._log = self._log * math.exp((self._judged_s - now_s) / self._tuning.shared_s) + 2 / len(count) * likelihood
        self._judged_s = now_s
        weights = PRIOR * np.exp(self._log - self._log.max())
        self.share = float(weights.dot(CANDIDATES) / weights.sum())

    def _filter(self, due: Ints, differences: Floats, white_m2: Floats, keep: Floats) -> Floats:
        """Log-likelihoods of the candidates, by the differences (p, 2) of the pairs that are due.

        white_m2: (p,), variance of their white noise. keep: (p,), how much of d is left since the last ones.
        """
        U, V = self._slow_m2[self._first[due]], self._slow_m2[self._second[due]]
        variance = (U + V)[:, None] - 2 * np.minimum(U, V)[:, None] * CANDIDATES
        x = keep[:, None, None] * self._x[due]
        P = variance + keep[:, None] ** 2 * (self._P[due] - variance)
        S = P + white_m2[:, None]
        y = differences[:, :, None] - x
        gate, squares = self._tuning.gps_gate_sigma**2, y**2 / S[:, None]
        fits = squares[:, :, 0].max(axis=1) <= gate  # the first candidate expects the largest ones
        gain = np.where(fits[:, None], P / S, 0.0)
        self._x[due], self._P[due] = x + gain[:, None] * y, P - gain * P
        likelihood = -np.log(S) - 0.5 * np.minimum(squares, gate).sum(axis=1)
        of_fitting: Floats = likelihood[fits].sum(axis=0)
        return of_fitting
