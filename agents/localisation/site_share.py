"""How much of a machine's GPS error a base station has too, from the fixes of both.

Sites differ, receivers too, and a base that fails may publish anything; so nobody configures the share. Both errors
are stationary Gauss-Markov processes, whose common part has the share s of the smaller one's variance. A small Kalman
filter per candidate s follows, in `map`,

    q+ = q + [u, turned u] m + walk   error of dead reckoning over a shift u     fix less it  z = q + e + white noise
    e+ = a e + noise                  slow error of the machine                  the base     z = b + d + white noise
    b+ = a b + noise                  slow error of the base                     cov(noise of e, noise of b) by s
    d+ = d + walk                     lasting error of the base
    m+ = a m + noise                  scale and heading of dead reckoning, as far as they are wrong

and the likelihood of what it did not expect weighs its candidate, as in `shared_errors`. Dead reckoning knows little
after a few minutes, but it is nearly free of GPS errors: the main filter's position has taken in already what is to be
judged here. Its error must not be overstated: a candidate explains an innovation that is smaller than expected by
errors in common. It is smooth, since a wrong heading lasts: a random walk that is as large after a minute would be
three times too large after a second, and made shares of 0.8 into 0.85 to 0.88.
"""

import math
from collections import Counter

import numpy as np

from agents.localisation.filters.motion import BASE_OFFSET_WALK, GpsError
from protocol.arrays import Floats
from protocol.machine.readings import Correction

CANDIDATES = np.array([0.0, 0.25, 0.5, 0.7, 0.85, 0.93, 0.98])
NONE_AT_FIRST = 0.5  # probability of no common part before anything is known: a base has to earn its weight
# A share lasts for so long on average, and then it may be any: however long a base did well, evidence of half a minute
# against it is enough.
LASTS_S = 3600.0
SPAN_NS = 1_000_000_000  # fixes and corrections of a second are averaged
# Believed velocities against the truth: what they miss within a second, the rest is a wrong scale and heading,
WALK_M2_PER_M = 0.03**2
TURN_STD, TURN_TIME_S = 0.02, 60.0  # of 0.01 to 0.02 each, which change within a minute, as ground and belief do
UNKNOWN_M2 = 10.0**2  # of q and d at first
WAIT_S = 5  # a span is judged so much later: links hold corrections up, and with the stamps wrong by 2 s none is alike
SILENT_NS = 10_000_000_000  # a receiver without fixes for so long makes room for another
GATE_SIGMA = 4.0  # fixes and corrections further off under every candidate tell nothing of a share,
RELOCK = 3  # and after so many spans of them in a row something else has jumped; a few more, and they look likely
STATES = 10
Q, E, B, D, M = (slice(i, i + 2) for i in range(0, STATES, 2))
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


class _Span:
    """What is known of one span; shift_m (2,), walk_m2: by dead reckoning, and the variance that this adds."""

    def __init__(self) -> None:
        self.fixes, self.corrections = _Mean(), _Mean()
        self.shift_m, self.walk_m2 = np.zeros(AXES), 0.0


class SiteShareEstimator:
    """Estimates how much of their slow errors one machine and one base share; of the machine, one receiver speaks."""

    def __init__(self) -> None:
        others = len(CANDIDATES) - 1
        self._at_first = np.array([NONE_AT_FIRST, *[(1 - NONE_AT_FIRST) / others] * others])
        self._weights = self._at_first
        self._x = np.zeros((len(CANDIDATES), STATES))
        self._P = np.zeros((len(CANDIDATES), STATES, STATES))
        self._machine, self._base = GpsError(1.0, 45.0), GpsError(1.0, 45.0)
        self._receiver, self._heard_ns = "", 0
        self._refused: Counter[str] = Counter()  # spans in a row
        self._spans: dict[int, _Span] = {}  # those that wait, by their numbers
        self._newest = self._filtered = 0  # numbers of spans

    @property
    def share(self) -> float:
        """Mean over the candidates, 0 to 1."""
        return float(self._weights.dot(CANDIDATES))

    def drive(self, stamp_ns: int, shift_m: Floats) -> None:
        """Note a step (2,) [m] by dead reckoning, which loses its place with it."""
        if span := self._span(stamp_ns):
            span.shift_m += shift_m
            span.walk_m2 += WALK_M2_PER_M * float(np.hypot(*shift_m))

    def add_fix(self, receiver: str, stamp_ns: int, off_m: Floats, white_m2: float, error: GpsError) -> None:
        """Take in what a fix is off from the antenna by dead reckoning (2,)."""
        if self._receiver not in (receiver, "") and stamp_ns - self._heard_ns < SILENT_NS:
            return
        if (span := self._span(stamp_ns)) is None:
            return
        if self._receiver != receiver:  # another slow error: it counts from anywhere
            self._receiver, span.walk_m2 = receiver, UNKNOWN_M2
        self._heard_ns = stamp_ns
        self._machine = error
        span.fixes.add(off_m, white_m2)

    def add_correction(self, correction: Correction) -> None:
        """Take in what the base is off."""
        if span := self._span(correction.stamp_ns):
            self._base = GpsError(correction.slow_m2, correction.time_s)
            span.corrections.add(np.array([correction.east_m, correction.north_m]), correction.white_m2)

    def _span(self, stamp_ns: int) -> _Span | None:
        """The span of a stamp, None of one that is over; filters those that have waited long enough."""
        number = stamp_ns // SPAN_NS
        if number > self._newest:
            self._newest = number
            for old in sorted(n for n in self._spans if n < number - WAIT_S):
                self._filter(old, self._spans.pop(old))
        if number <= self._filtered:
            return None
        return self._spans.setdefault(number, _Span())

    def _filter(self, number: int, span: _Span) -> None:
        if not self._filtered:
            first_m2 = UNKNOWN_M2, self._machine.variance_m2, self._base.variance_m2, UNKNOWN_M2, TURN_STD**2
            self._P[:] = np.diag(np.repeat(first_m2, AXES))
            self._filtered = number
        dt_s, self._filtered = (number - self._filtered) * SPAN_NS * 1e-9, number
        self._predict(dt_s, span)
        lasts, likelihood = math.exp(-dt_s / LASTS_S), np.zeros(len(CANDIDATES))
        if span.fixes.count:
            likelihood += self._gated("fixes", E, Q, span.fixes)
        if span.corrections.count:
            likelihood += self._gated("corrections", B, D, span.corrections)
        weights = (lasts * self._weights + (1 - lasts) * self._at_first) * np.exp(likelihood - likelihood.max())
        self._weights = weights / weights.sum()

    def _predict(self, dt_s: float, span: _Span) -> None:
        machine, base = self._machine, self._base
        fade_e, fade_b, fade_m = (math.exp(-dt_s / time_s) for time_s in (machine.time_s, base.time_s, TURN_TIME_S))
        F = np.diag(np.repeat([1.0, fade_e, fade_b, 1.0, fade_m], AXES))
        east_m, north_m = span.shift_m
        F[Q, M] = [[east_m, -north_m], [north_m, east_m]]
        noise = (
            span.walk_m2,
            machine.variance_m2 * (1 - fade_e**2),
            base.variance_m2 * (1 - fade_b**2),
            BASE_OFFSET_WALK**2 * dt_s,
            TURN_STD**2 * (1 - fade_m**2),
        )
        self._x = self._x @ F.T
        self._P = F @ self._P @ F.T + np.diag(np.repeat(noise, AXES))
        common = CANDIDATES * min(machine.variance_m2, base.variance_m2) * (1 - fade_e * fade_b)
        # one noise, answered with two correlation times
        common *= 2 * math.sqrt(machine.time_s * base.time_s) / (machine.time_s + base.time_s)
        of_both = common[:, None, None] * np.eye(AXES)
        self._P[:, E, B] += of_both
        self._P[:, B, E] += of_both

    def _gated(self, what: str, slow: slice, free: slice, mean: _Mean) -> Floats:
        """Log-likelihood of a mean; none of one that no candidate can explain: an outlier, or something jumped.

        After a few of these the free state is opened: the base was moved, or dead reckoning lost its place.
        """
        before = self._x, self._P
        likelihood, nis = self._condition(slow, free, mean)
        if nis.min() <= AXES * GATE_SIGMA**2:
            self._refused[what] = 0
            return likelihood
        self._x, self._P = before
        self._refused[what] += 1
        if self._refused[what] >= RELOCK:
            self._refused[what] = 0
            self._P[:, free, free] += UNKNOWN_M2 * np.eye(AXES)
        return np.zeros(len(CANDIDATES))

    def _condition(self, first: slice, second: slice, mean: _Mean) -> tuple[Floats, Floats]:
        """Condition all candidates on the sum of two states, one axis after the other.

        Returns log-likelihood and normalised innovation squared of each (n,).
        """
        likelihood, nis = np.zeros(len(CANDIDATES)), np.zeros(len(CANDIDATES))
        for axis in range(AXES):
            i, j = first.start + axis, second.start + axis
            Ph = self._P[:, i] + self._P[:, j]
            S = Ph[:, i] + Ph[:, j] + mean.white_m2
            y = mean.value_m[axis] - self._x[:, i] - self._x[:, j]
            self._x = self._x + Ph * (y / S)[:, None]
            self._P = self._P - Ph[:, :, None] * Ph[:, None, :] / S[:, None, None]
            likelihood -= (np.log(S) + y**2 / S) / 2
            nis += y**2 / S
        return likelihood, nis
