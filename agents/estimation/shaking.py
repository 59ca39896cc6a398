"""How much a body shakes, how far limits widen, and longer steps that average it out.

Vibration changes from step to step, motion hardly. A shaking body goes nowhere: its mean over n steps falls with n, not
with the root of n as white noise.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from agents.estimation.balance import BalanceStep

MEASURED_S = 5.0  # time constant: short shocks count little, a start soon
SIGMA = 3.0  # standard deviations by which a limit widens
LONG_S = 0.301  # duration of joined steps, six of 50 ms: estimators want one within 0.15 s of a stamp
GAP_NS = 100_000_000  # gap that separates steps


class Shaking:
    """Follows a signal; usual: the standard deviation of a step that limits allow for."""

    def __init__(self, usual: float) -> None:
        self._usual = usual
        self._last = math.nan
        self._variance = self._dt_s = 0.0

    def update(self, dt_s: float, value: float) -> None:
        """Add a step."""
        change, self._last, self._dt_s = value - self._last, value, dt_s
        if math.isfinite(change):
            self._variance += min(dt_s / MEASURED_S, 1.0) * (0.5 * change**2 - self._variance)

    @property
    def variance(self) -> float:
        """Variance of a step beyond the usual."""
        return max(self._variance - self._usual**2, 0.0)

    def margin(self, mean_s: float = 0.0) -> float:
        """Widening of a limit for a step, or for a low-pass of this time constant."""
        share = min(self._dt_s / mean_s, 1.0) if mean_s else 1.0
        return SIGMA * math.sqrt(self.variance * share / (2 - share))


class LongerSteps:
    """Joins successive balance steps while the machine shakes."""

    def __init__(self) -> None:
        self._waiting: list[BalanceStep] = []

    def clear(self) -> None:
        """Drop waiting steps."""
        self._waiting.clear()

    def add(self, step: BalanceStep, *, shakes: bool) -> list[BalanceStep]:
        """The steps that this one completes."""
        ready = []
        if self._waiting and not _follows(self._waiting[-1], step):
            ready.append(self._joined())
        self._waiting.append(step)
        if not shakes or sum(waiting.dt_s for waiting in self._waiting) + step.dt_s > LONG_S:
            ready.append(self._joined())
        return ready

    def _joined(self) -> BalanceStep:
        steps = self._waiting.copy()
        self.clear()
        return _join(steps) if len(steps) > 1 else steps[0]


def _follows(last: BalanceStep, step: BalanceStep) -> bool:
    return last.regressor * step.regressor > 0 and step.stamp_ns - last.stamp_ns <= GAP_NS


def _join(steps: Sequence[BalanceStep]) -> BalanceStep:
    """Sums of time and distance, means of the rest."""
    count = len(steps)
    return replace(
        steps[-1],
        dt_s=math.fsum(step.dt_s for step in steps),
        distance_m=math.fsum(step.distance_m for step in steps),
        raw=math.fsum(step.raw for step in steps) / count,
        regressor=math.fsum(step.regressor for step in steps) / count,
        share=math.fsum(step.share for step in steps) / count,
        lead_share=math.fsum(step.lead_share for step in steps) / count,
    )
