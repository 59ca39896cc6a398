"""Filter consistency: size and whiteness of the last innovations of a receiver, and the size of its slow error.

Of a consistent filter the normalised innovation squared (NIS), per component, is 1 on average, and successive
innovations are not correlated (white): Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 5.4.

Innovations show errors that change faster than the filter takes for possible. An error that is larger and as much
slower leaves no trace in them: the filter moves with it, and the ellipse misses the truth for as long as it lasts. It
shows where another receiver, which errs on its own, disagrees: then the slow errors that the filter believes in are
larger than stated. With one receiver, or with several that err alike, nobody can tell.

A receiver that misstates its error shows it in the size of its innovations. So its variance is taken times a factor
that brings their NIS to 1 (stochastic approximation: Robbins and Monro 1951; adaptive filters: Mehra 1972).
"""

import math
from collections import deque
from dataclasses import asdict, dataclass, field

import numpy as np

from agents.localisation.filters.belief import Conditioned
from agents.localisation.tuning import TUNING, LocalisationTuning

REMEMBERED = 150  # innovations: half a minute of a 5 Hz receiver
ENOUGH = 50  # fewer innovations show nothing
MAX_GATED, MIN_NIS, MAX_NIS, MAX_CORRELATION = 0.2, 0.2, 2.5, 0.6
LEVEL_S = 300.0  # how long slow errors are remembered: some independent ones of less than a minute
MAX_LEVEL = 1.6  # twice what they are on average where their stated variance is right
MAX_SHARE = 0.5  # receivers with more of their slow variance in common do not check each other
PAUSE_S = 2.0  # innovations further apart teach no more than that
INCONSISTENT, CONSISTENT, CANNOT_TELL = "inconsistent", "consistent", "cannot_tell"


@dataclass(frozen=True)
class Consistency:
    """Of the last innovations of a receiver: share that was gated, NIS per component, correlation of successive ones.

    slow_error: mean square of its believed slow error over the stated variance, at most about 1 if that is right.
    is_checked: whether another receiver, which errs on its own, would show a slow error that is larger.
    variance_factor: what the stated variance is taken times [-].
    """

    gated: float
    nis: float
    correlation: float
    slow_error: float
    is_checked: bool
    variance_factor: float = 1.0

    @property
    def verdict(self) -> str:
        """Whether the filter's covariance is refuted, holds, or holds as far as anybody can tell with one receiver."""
        if not (
            self.gated <= MAX_GATED
            and MIN_NIS <= self.nis <= MAX_NIS
            and abs(self.correlation) <= MAX_CORRELATION
            and self.slow_error <= MAX_LEVEL
        ):
            return INCONSISTENT
        return CONSISTENT if self.is_checked else CANNOT_TELL

    @property
    def report(self) -> dict[str, float | bool | str]:
        """All of it in plain values."""
        return {**asdict(self), "verdict": self.verdict}


class InnovationMonitor:
    """Remembers the last innovations of one receiver. tuning: by which its variance follows them; None: it does not."""

    def __init__(self, tuning: LocalisationTuning | None = None) -> None:
        self._factor = VarianceFactor(tuning=tuning) if tuning else None
        self._gated: deque[bool] = deque(maxlen=REMEMBERED)
        self._last: deque[tuple[float, ...]] = deque(maxlen=REMEMBERED)
        self._slow_error, self._slow_ns = 1.0, 0

    @property
    def variance_factor(self) -> float:
        """What the variance that the receiver states is taken times [-]."""
        return self._factor.factor if self._factor else 1.0

    def note(self, result: Conditioned, slow_error: float | None = None) -> None:
        """Remember a result of the filter; one without a finite innovation shows nothing.

        slow_error: square of the slow error believed now over its stated variance, per component.
        """
        if not math.isfinite(result.nis):
            return
        if self._factor:
            self._factor.note(result)
        self._gated.append(not result.accepted)
        std = np.sqrt(np.diag(result.innovation_covariance))
        self._last.append(tuple((result.innovation / std).tolist()))
        if slow_error is not None:
            stamp_ns = result.belief.stamp_ns
            passed_s = max(stamp_ns - (self._slow_ns or stamp_ns), 0) * 1e-9
            self._slow_ns = max(stamp_ns, self._slow_ns)
            self._slow_error -= math.expm1(-passed_s / LEVEL_S) * (slow_error - self._slow_error)

    def consistency(self, *, is_checked: bool = False) -> Consistency | None:
        """Consistency of the last innovations; None as long as there are too few."""
        if len(self._last) < ENOUGH:
            return None
        normalised = np.array(self._last)
        square = float((normalised**2).mean())
        correlation = float((normalised[1:] * normalised[:-1]).mean()) / max(square, 1e-12)
        gated = sum(self._gated) / len(self._gated)
        return Consistency(gated, square, correlation, self._slow_error, is_checked, self.variance_factor)


@dataclass
class VarianceFactor:
    """What the variance that a receiver states is multiplied by [-], the slow part too, as its innovations show it."""

    factor: float = 1.0
    tuning: LocalisationTuning = field(default=TUNING, repr=False)
    _stamp_ns: int = field(default=0, repr=False)

    def note(self, result: Conditioned) -> None:
        """Follow a finite innovation (k,) that was accepted: others may be the filter's fault, or outliers."""
        if not result.accepted:
            return
        stamp_ns, tuning = result.belief.stamp_ns, self.tuning
        passed_s = min(max(stamp_ns - (self._stamp_ns or stamp_ns), 0) * 1e-9, PAUSE_S)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        surplus = min(result.nis / len(result.innovation), tuning.clipped_nis) - 1.0
        followed = self.factor * math.exp(passed_s / tuning.adapting_s * surplus)
        self.factor = min(max(followed, tuning.least_factor), tuning.most_factor)
