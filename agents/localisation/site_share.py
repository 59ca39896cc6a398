"""How much of a machine's GPS error a base station sees: the correlation of both errors, from the fixes of both.

Sites differ, receivers too, and a faulty base may publish anything; so nobody configures the share. Both errors are
stationary Gauss-Markov processes of correlation rho. A small Kalman filter per candidate rho follows, per axis,

    q+ = q + walk            error of dead reckoning [m]          fix less dead reckoning   z = q + e + white
    e+ = a e + noise         slow error of the machine            error of the base         z = b + d + white
    b+ = a b + noise         slow error of the base               cov(noise of e, noise of b) ~ rho
    d+ = d                   lasting error of the base

and the likelihood of what it did not expect weighs its candidate (multiple-model estimation: Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, section 11.6.2). Dead reckoning is short-lived
knowledge, but free of all GPS errors: the filter's own position has taken in what is to be judged here.
"""

import numpy as np

from protocol.arrays import Floats

CANDIDATES = np.array([0.0, 0.3, 0.6, 0.8, 0.9, 0.97])
NONE_PRIOR = 0.5  # of no correlation at all: a base has to earn its weight
MEMORY_S = 300.0  # how long what was seen counts: a base that goes wrong must lose its weight
SPAN_S = 1.0  # fixes and corrections are averaged over so long
RECKONED_M2_PER_M = 0.06**2  # variance that dead reckoning gains per metre driven
UNKNOWN_M2 = 10.0**2  # of q and d at first
GATE_SIGMA = 5.0  # corrections further off under every candidate are no news of a share,
RELOCK = 10  # and after so many spans in a row the base counts as another one
Q, E, B, D = range(4)
OF_FIX, OF_BASE = np.array([1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])


class _Mean:
    """Mean of values (2,) [m] that come within a span, and the variance of its white noise."""

    def __init__(self) -> None:
        self.n, self._sum, self._white_m2 = 0, np.zeros(2), 0.0

    def add(self, value_m: Floats, white_m2: float) -> None:
        self.n += 1
        self._sum = self._sum + value_m
        self._white_m2 += white_m2

    @property
    def value_m(self) -> Floats:
        return self._sum / self.n

    @property
    def white_m2(self) -> float:
        return self._white_m2 / self.n**2


class ShareEstimator:
    """Estimates the correlation of the slow errors of one machine and one base; `share` is its mean by now."""

    def __init__(self) -> None:
        others = np.full(len(CANDIDATES) - 1, (1 - NONE_PRIOR) / (len(CANDIDATES) - 1))
        self._prior = np.log(np.concatenate([[NONE_PRIOR], others]))
        self._log = self._prior.copy()
        self._x = np.zeros((len(CANDIDATES), 2, 4))  # of both axes
        self._P = np.zeros((len(CANDIDATES), 4, 4))  # the same for both: all noise is
        self._slow_m2, self._time_s = [0.0, 0.0], [45.0, 45.0]  # of machine and base
        self._span_ns = self._done_ns = 0
        self._driven_m = 0.0
        self._fixes, self._corrections = _Mean(), _Mean()
        self._refused = 0

    @property
    def share(self) -> float:
        """Mean of the correlation, 0 to 1."""
        weights = np.exp(self._log - self._log.max())
        return float(weights.dot(CANDIDATES) / weights.sum())

    def add_fix(self, stamp_ns: int, off_m: Floats, white_m2: float, slow_m2: float, time_s: float) -> None:
        """Take in a fix less the antenna by dead reckoning (2,)."""
        self._close(stamp_ns)
        self._slow_m2[0], self._time_s[0] = slow_m2, time_s
        self._fixes.add(off_m, white_m2)

    def add_correction(self, stamp_ns: int, off_m: Floats, white_m2: float, slow_m2: float, time_s: float) -> None:
        """Take in what the base is off (2,)."""
        self._close(stamp_ns)
        self._slow_m2[1], self._time_s[1] = slow_m2, time_s
        self._corrections.add(off_m, white_m2)

    def drive(self, distance_m: float) -> None:
        """Note a distance driven: dead reckoning loses its place with it."""
        self._driven_m += distance_m

    def lose_track(self) -> None:
        """Note that the track of dead reckoning begins anew."""
        self._driven_m = UNKNOWN_M2 / RECKONED_M2_PER_M

    def _close(self, stamp_ns: int) -> None:
        """Filter the span before, if this stamp begins a new one."""
        span_ns = round(SPAN_S * 1e9)
        if stamp_ns // span_ns == self._span_ns:
            return
        self._span_ns = stamp_ns // span_ns
        if self._fixes.n or self._corrections.n:
            self._filter(stamp_ns)
        self._fixes, self._corrections = _Mean(), _Mean()

    def _filter(self, stamp_ns: int) -> None:
        dt_s, self._done_ns = (stamp_ns - self._done_ns) * 1e-9 if self._done_ns else 0.0, stamp_ns
        if not self._P.any():
            self._P[:, Q, Q] = self._P[:, D, D] = UNKNOWN_M2
            self._P[:, E, E], self._P[:, B, B] = self._slow_m2
        self._predict(max(dt_s, 0.0))
        news = np.zeros(len(CANDIDATES))
        if self._fixes.n:
            news += self._condition(OF_FIX, self._fixes)[0]
        if self._corrections.n:
            news += self._judge_correction()
        keep = np.exp(-dt_s / MEMORY_S)
        self._log = keep * self._log + (1 - keep) * self._prior + news
        self._log -= self._log.max()

    def _predict(self, dt_s: float) -> None:
        fade = np.exp(-dt_s / np.array(self._time_s))
        factors = np.array([1.0, *fade, 1.0])
        self._x *= factors
        self._P *= np.outer(factors, factors)
        self._P[:, Q, Q] += RECKONED_M2_PER_M * self._driven_m
        self._driven_m = 0.0
        slow, (e, b) = np.array(self._slow_m2), (E, B)
        self._P[:, e, e] += slow[0] * (1 - fade[0] ** 2)
        self._P[:, b, b] += slow[1] * (1 - fade[1] ** 2)
        both = joint_noise_m2(CANDIDATES, slow, np.array(self._time_s), dt_s)
        self._P[:, e, b] += both
        self._P[:, b, e] += both

    def _judge_correction(self) -> Floats:
        """Log-likelihood of a correction, none of one that no candidate can explain: the base jumped, or was moved."""
        before = self._x.copy(), self._P.copy()
        news, nis = self._condition(OF_BASE, self._corrections)
        if nis.min() <= 2 * GATE_SIGMA**2:
            self._refused = 0
            return news
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
        self._x += (Ph / S[:, None])[:, None, :] * y[:, :, None]
        self._P -= Ph[:, :, None] * Ph[:, None, :] / S[:, None, None]
        nis = (y**2).sum(axis=1) / S
        return -np.log(S) - nis / 2, nis


def joint_noise_m2(share: Floats, variances_m2: Floats, times_s: Floats, dt_s: float) -> Floats:
    """Covariance of what two Gauss-Markov errors gain in a step, so that their correlation stays `share`, or goes there.

    Errors of different correlation times cannot be wholly the same: beyond 2 sqrt(t1 t2) / (t1 + t2) no noise is left.
    """
    most = 2 * np.sqrt(times_s.prod()) / times_s.sum()
    both: Floats = np.minimum(share, 0.99 * most) * np.sqrt(variances_m2.prod())
    return both * -np.expm1(-dt_s * (1 / times_s).sum())
