"""Filter consistency: size and whiteness of the last innovations of a sensor.

Of a consistent filter the normalised innovation squared (NIS), per component, is 1 on average, and successive
innovations are not correlated (white): Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 5.4.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Conditioned

REMEMBERED = 150  # innovations: half a minute of a 5 Hz receiver
ENOUGH = 50  # fewer innovations show nothing
MAX_GATED, MIN_NIS, MAX_NIS, MAX_CORRELATION = 0.2, 0.2, 2.5, 0.6


@dataclass(frozen=True)
class Consistency:
    """Of the last innovations of a sensor: share that was gated, NIS per component, correlation of successive ones."""

    gated: float
    nis: float
    correlation: float

    @property
    def is_good(self) -> bool:
        """Whether the filter may be believed."""
        return self.gated <= MAX_GATED and MIN_NIS <= self.nis <= MAX_NIS and abs(self.correlation) <= MAX_CORRELATION


class InnovationMonitor:
    """Remembers the last innovations of one sensor."""

    def __init__(self) -> None:
        self._gated: deque[bool] = deque(maxlen=REMEMBERED)
        self._last: deque[tuple[float, ...]] = deque(maxlen=REMEMBERED)

    def note(self, result: Conditioned) -> None:
        """Remember a result of the filter; one without a finite innovation shows nothing."""
        if not math.isfinite(result.nis):
            return
        self._gated.append(not result.accepted)
        std = np.sqrt(np.diag(result.innovation_covariance))
        self._last.append(tuple((result.innovation / std).tolist()))

    def consistency(self) -> Consistency | None:
        """Consistency of the last innovations; None as long as there are too few."""
        if len(self._last) < ENOUGH:
            return None
        normalised = np.array(self._last)
        square = float((normalised**2).mean())
        correlation = float((normalised[1:] * normalised[:-1]).mean()) / max(square, 1e-12)
        return Consistency(sum(self._gated) / len(self._gated), square, correlation)
