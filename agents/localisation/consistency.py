"""Filter consistency: size and whiteness of a receiver's innovations, and size of its slow error.

In a consistent filter the normalised innovation squared (NIS) averages 1 per component, and innovations are white:
Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, section 5.4.

Innovations show errors faster than modelled. The filter follows a larger, slower error without a trace, and the ellipse
misses the truth. It shows if another receiver with independent errors disagrees: then estimated slow errors exceed
their stated size. One receiver, or several with common errors, cannot tell.

Misstated errors change the size of innovations, so a factor on the variance brings NIS to 1 (stochastic approximation:
Robbins and Monro 1951; adaptive filters: Mehra 1972).
"""

import math
from collections import deque
from dataclasses import asdict, dataclass, field

import numpy as np

from agents.localisation.filters.belief import Conditioned
from agents.localisation.tuning import TUNING, LocalisationTuning

REMEMBERED = 150  # innovations: half a minute at 5 Hz
ENOUGH = 50  # minimum number of innovations
MAX_GATED, MIN_NIS, MAX_NIS, MAX_CORRELATION = 0.2, 0.2, 2.5, 0.6
LEVEL_S = 300.0  # memory of slow errors: several independent ones of less than a minute
MAX_LEVEL = 1.6  # twice the average with correctly stated variance
MAX_SHARE = 0.5  # common share beyond which receivers do not check each other
PAUSE_S = 2.0  # longest interval credited to one innovation
INCONSISTENT, CONSISTENT, CANNOT_TELL = "inconsistent", "consistent", "cannot_tell"


@dataclass(frozen=True)
class Consistency:
    """Recent innovations of a receiver: gated share, NIS per component, lag-one correlation.

    slow_error: mean squared estimated slow error over its stated variance, at most about 1 if right. is_checked:
    whether an independent receiver would show a larger slow error. variance_factor: applied to the stated variance [-].
    """

    gated: float
    nis: float
    correlation: float
    slow_error: float
    is_checked: bool
    variance_factor: float = 1.0

    @property
    def verdict(self) -> str:
        """Whether the filter's covariance is refuted, holds, or cannot be checked."""
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
        """All in plain values."""
        return {**asdict(self), "verdict": self.verdict}


class InnovationMonitor:
    """Recent innovations of one receiver. tuning: of its variance factor; None for no factor."""

    def __init__(self, tuning: LocalisationTuning | None = None) -> None:
        self._factor = VarianceFactor(tuning=tuning) if tuning else None
        self._gated: deque[bool] = deque(maxlen=REMEMBERED)
        self._last: deque[tuple[float, ...]] = deque(maxlen=REMEMBERED)
        self._slow_error, self._slow_ns = 1.0, 0

    @property
    def variance_factor(self) -> float:
        """Factor on the receiver's stated variance [-]."""
        return self._factor.factor if self._factor else 1.0

    def note(self, result: Conditioned, slow_error: float | None = None) -> None:
        """Add a result. slow_error: current squared slow error over stated variance, per component."""
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
        """Recent consistency; None with too few innovations."""
        if len(self._last) < ENOUGH:
            return None
        normalised = np.array(self._last)
        square = float((normalised**2).mean())
        correlation = float((normalised[1:] * normalised[:-1]).mean()) / max(square, 1e-12)
        gated = sum(self._gated) / len(self._gated)
        return Consistency(gated, square, correlation, self._slow_error, is_checked, self.variance_factor)


@dataclass
class VarianceFactor:
    """Factor on a receiver's stated variance, slow part included [-], by its innovations."""

    factor: float = 1.0
    tuning: LocalisationTuning = field(default=TUNING, repr=False)
    _stamp_ns: int = field(default=0, repr=False)

    def note(self, result: Conditioned) -> None:
        """Follow an accepted finite innovation (k,); others may be outliers or the filter's fault."""
        if not result.accepted:
            return
        stamp_ns, tuning = result.belief.stamp_ns, self.tuning
        passed_s = min(max(stamp_ns - (self._stamp_ns or stamp_ns), 0) * 1e-9, PAUSE_S)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        surplus = min(result.nis / len(result.innovation), tuning.clipped_nis) - 1.0
        followed = self.factor * math.exp(passed_s / tuning.adapting_s * surplus)
        self.factor = min(max(followed, tuning.least_factor), tuning.most_factor)
