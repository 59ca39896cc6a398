"""Clocks: the steady lead of one machine's stamps over those of the others, whenever its samples arrive.

Only stamps are compared with stamps: sites replay old logs, and run faster than real time. A machine that was offline
and catches up is behind too, but its lag shrinks; where the others have stopped, the lead of one that works on grows.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from mapserver.trust.judgement import Finding
from mapserver.trust.machine_vote import AGREE, DISAGREE, UNKNOWN

_LOOKS = 16  # in a span
_LOOKS_NEEDED = 8


class ClockWatch:
    """The newest stamps of all machines, as they were whenever one of them sent something.

    span_s: a difference must be steady for so long [s of the machine's stamps]; steady_s: within so much [s];
    limit_s: what batches and links may explain [s].
    """

    def __init__(self, span_s: float, steady_s: float, limit_s: float) -> None:
        self._span_s = span_s
        self._steady_s = steady_s
        self._limit_s = limit_s
        self._newest: dict[str, int] = {}
        self._looks: dict[str, deque[tuple[int, dict[str, int]]]] = {}

    def add(self, machine: str, newest_ns: int) -> None:
        """Note the newest stamp of a batch; in order of arrival."""
        looks = self._looks.setdefault(machine, deque(maxlen=_LOOKS + 1))
        if not looks or abs(newest_ns - looks[-1][0]) >= self._span_s * 1e9 / _LOOKS:
            looks.append((newest_ns, dict(self._newest)))
        self._newest[machine] = newest_ns

    def compare(self, machine: str, other: str) -> tuple[float, Finding]:
        """By how much [s] one machine's stamps are ahead of another's, NaN where that is not known; what it means."""
        looks = [(own, seen[other]) for own, seen in self._looks[machine] if other in seen]
        if len(looks) < _LOOKS_NEEDED:
            return np.nan, Finding()
        own, theirs = np.array(looks, np.int64).T
        leads_s = (own - theirs) / 1e9
        lead_s = float(np.median(leads_s))
        excess = abs(lead_s) / self._limit_s
        if np.abs(leads_s).max() <= self._limit_s:
            return lead_s, Finding(excess, AGREE)
        steady = np.ptp(leads_s) <= self._steady_s and np.ptp(own) >= 0.75e9 * self._span_s
        return lead_s, Finding(excess, DISAGREE if steady and excess > 1 else UNKNOWN)
