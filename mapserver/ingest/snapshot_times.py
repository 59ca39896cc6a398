"""When snapshots are taken: often enough that a restart is quick, seldom enough that they cost little. No clock."""

from __future__ import annotations

import math

RESTART_SAMPLES = 500_000  # more than so many that a restart would have to fold, about a second, bring one forward
SHARE = 0.05  # of the time that is spent on snapshots at most


class SnapshotTimes:
    """Times are of one steady clock [s]."""

    def __init__(self, every_s: float, now_s: float) -> None:
        """every_s: a snapshot is due so long after the last one."""
        self._every_s = every_s
        self._began_s = self._earliest_s = now_s

    def due_s(self, samples: int) -> float:
        """When the next one is due, while a restart would have to fold so many samples; never while one is written."""
        wait_s = 0.0 if samples >= RESTART_SAMPLES else self._every_s
        return max(self._began_s + wait_s, self._earliest_s)

    def began(self, now_s: float) -> None:
        """One is being taken."""
        self._began_s, self._earliest_s = now_s, math.inf

    def ended(self, now_s: float, *, failed: bool = False) -> None:
        """It is written, or it failed: what kept it from the disk will not go at once."""
        pause_s = (now_s - self._began_s) * (1 / SHARE - 1)
        self._earliest_s = now_s + max(pause_s, self._every_s if failed else 0.0)
