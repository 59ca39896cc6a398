"""Readings must come in the order of their stamps: duplicates and late ones are refused, clock jumps are noticed."""

from __future__ import annotations

from collections import Counter
from enum import Enum

from protocol.machine.readings import Reading

LATE_LIMIT = 200  # so many late readings in a row are a clock that was set back, not a late sensor


class Verdict(Enum):
    """What to do with a reading."""

    TAKE = "take"
    REFUSE = "refuse"
    RESTART = "restart"  # take it, but nothing before it counts any more


class Order:
    """Judges readings of one machine. gap_s: a pause longer than this ends dead reckoning.

    late_s: how far behind the newest reading one of another sensor may come.
    """

    def __init__(self, gap_s: float, late_s: float) -> None:
        self.counters: Counter[str] = Counter()
        self._gap_ns = round(gap_s * 1e9)
        self._late_ns = round(late_s * 1e9)
        self._newest_ns = 0
        self._by_sensor: dict[str, int] = {}
        self._late_in_a_row = 0

    def judge(self, reading: Reading) -> Verdict:
        """Judge one reading, and count it if it is not simply taken."""
        stamp, last = reading.stamp_ns, self._by_sensor.get(reading.sensor, 0)
        if self._newest_ns and stamp > self._newest_ns + self._gap_ns:
            return self._restart(reading, "gap_restarts")
        if stamp <= last or stamp < self._newest_ns - self._late_ns:
            self._late_in_a_row += 1
            if self._late_in_a_row > LATE_LIMIT:
                return self._restart(reading, "clock_back_restarts")
            self.counters["reading_duplicate" if stamp == last else "reading_late"] += 1
            return Verdict.REFUSE
        self._late_in_a_row = 0
        self._by_sensor[reading.sensor] = stamp
        self._newest_ns = max(self._newest_ns, stamp)
        return Verdict.TAKE

    def _restart(self, reading: Reading, reason: str) -> Verdict:
        self.counters[reason] += 1
        self._by_sensor = {reading.sensor: reading.stamp_ns}
        self._newest_ns, self._late_in_a_row = reading.stamp_ns, 0
        return Verdict.RESTART
