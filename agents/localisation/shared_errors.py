"""Share of slow error that one machine's GPS receivers have in common, by differences of their fixes.

Antennas a metre apart see the same satellites and air, but their own reflections. The difference of two fixes, less
that of the reckoned antennas, cancels position and common errors. For a share s of slow variances U and V, a
Gauss-Markov process per axis and white noise remain:

    difference = d + white        variance of d = U + V - 2 s min(U, V)

It lasts half a minute: too few independent values for a mean square. A Kalman filter per candidate s tracks d, weighted
by likelihood (multiple-model estimation, Magill 1965; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, section 11.6.2). The mean serves, as common variance is linear in s. Receivers better than
stated seem to share the rest: safe.
"""

import math
from dataclasses import dataclass

import numpy as np

from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats, Ints

CANDIDATES = np.concatenate([[0.0], (np.arange(16) + 0.5) / 16])
# Prior: as likely nothing as anything (Jeffreys 1961, Theory of Probability, 5.0). Uncorrected receivers share nearly
# all, with a reference station half, amid reflections less (docs/how-the-map-comes-about.md, measured facts).
PRIOR = np.array([0.5] + [0.5 / 16] * 16)
MOST_SHARED = 0.99  # bound of a share: wholly common errors have no definite covariance
SPAN_NS = 1_000_000_000  # averaging time of fixes


@dataclass(frozen=True)
class SharedFix:
    """A fix and its reckoned antenna, (2,) each [m].

    white_m2, slow_m2: variances per axis. time_s: correlation time of the slow part.
    """

    receiver: int
    stamp_ns: int
    position_m: Floats
    reckoned_m: tuple[float, float]
    white_m2: float
    slow_m2: float
    time_s: float


class ShareEstimator:
    """Estimates `share`, the common part of the receivers' slow variance."""

    def __init__(self, receivers: int, tuning: LocalisationTuning = TUNING) -> None:
        self.share, self._tuning = float(PRIOR.dot(CANDIDATES)), tuning
        self._first, self._second = np.triu_indices(receivers, 1)  # of p pairs
        self._x = np.zeros((len(self._first), 2, len(CANDIDATES)))
        self._P = np.zeros((len(self._first), len(CANDIDATES)))  # equal for both axes
        self._compared = np.full(len(self._first), -np.inf)  # when last [s]
        self._log, self._judged_s = np.zeros(len(CANDIDATES)), 0.0  # log-likelihoods, and their last change
        self._slow_m2, self._time_s = np.ones(receivers), np.ones(receivers)
        self._span = 0  # its number; per receiver: count, sums of fix, reckoned antenna, white variance
        self._sums = np.zeros((receivers, 6))

    def add(self, fix: SharedFix, rotation_rad: float) -> None:
        """Add a fix; rotation_rad: of the dead-reckoned frame in `map`."""
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
        # g receivers have g (g - 1) / 2 pairs, but g - 1 independent differences
        self._log = self._log * math.exp((self._judged_s - now_s) / self._tuning.shared_s) + 2 / len(count) * likelihood
        self._judged_s = now_s
        weights = PRIOR * np.exp(self._log - self._log.max())
        self.share = float(weights.dot(CANDIDATES) / weights.sum())

    def _filter(self, due: Ints, differences: Floats, white_m2: Floats, keep: Floats) -> Floats:
        """Log-likelihoods of the candidates by differences (p, 2) of due pairs; keep: (p,), remaining share of d."""
        U, V = self._slow_m2[self._first[due]], self._slow_m2[self._second[due]]
        variance = (U + V)[:, None] - 2 * np.minimum(U, V)[:, None] * CANDIDATES
        x = keep[:, None, None] * self._x[due]
        P = variance + keep[:, None] ** 2 * (self._P[due] - variance)
        S = P + white_m2[:, None]
        y = differences[:, :, None] - x
        gate, squares = self._tuning.gps_gate_sigma**2, y**2 / S[:, None]
        fits = squares[:, :, 0].max(axis=1) <= gate  # the first candidate has the widest gate
        gain = np.where(fits[:, None], P / S, 0.0)
        self._x[due], self._P[due] = x + gain[:, None] * y, P - gain * P
        likelihood = -np.log(S) - 0.5 * np.minimum(squares, gate).sum(axis=1)
        of_fitting: Floats = likelihood[fits].sum(axis=0)
        return of_fitting
