"""Order of readings by their stamps: duplicates and late readings are refused, jumps of the clock are noticed."""

from collections import Counter
from enum import Enum

from protocol.machine.readings import Reading

GAP_NS = 5_000_000_000  # a longer pause in all readings ends dead reckoning: the machine may be anywhere after it
LATE_NS = 500_000_000  # how far behind the newest reading one of another sensor may come
LATE_LIMIT = 200  # so many late readings in a row are a clock that was set back, not a late sensor


class Decision(Enum):
    """What to do with a reading."""

    ACCEPT = "accept"
    REFUSE = "refuse"
    RESTART = "restart"  # accept it, and forget all before it


class StreamOrder:
    """Decides on the readings of one machine, by their stamps; `counters` holds refusals and restarts by reason."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._newest_ns = 0
        self._by_sensor: dict[str, int] = {}
        self._late_in_a_row = 0

    def decide(self, reading: Reading) -> Decision:
        """Decide on one reading, and count it if it is not simply accepted."""
        stamp, last = reading.stamp_ns, self._by_sensor.get(reading.sensor, 0)
        if self._newest_ns and stamp > self._newest_ns + GAP_NS:
            return self._restart(reading, "gap_restarts")
        if stamp <= last or stamp < self._newest_ns - LATE_NS:
            self._late_in_a_row += 1
            if self._late_in_a_row > LATE_LIMIT:
                return self._restart(reading, "clock_back_restarts")
            self.counters["reading_duplicate" if stamp == last else "reading_late"] += 1
            return Decision.REFUSE
        self._late_in_a_row = 0
        self._by_sensor[reading.sensor] = stamp
        self._newest_ns = max(self._newest_ns, stamp)
        return Decision.ACCEPT

    def _restart(self, reading: Reading, reason: str) -> Decision:
        self.counters[reason] += 1
        self._by_sensor = {reading.sensor: reading.stamp_ns}
        self._newest_ns, self._late_in_a_row = reading.stamp_ns, 0
        return Decision.RESTART
