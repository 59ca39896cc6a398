"""Order of readings by their stamps: those of one stamp belong together, late ones are refused, clock jumps noticed."""

from collections import Counter
from collections.abc import Iterable, Iterator
from enum import Enum
from itertools import groupby
from operator import attrgetter

from protocol.machine.readings import Reading

GAP_NS = 5_000_000_000  # a longer pause in all readings ends dead reckoning: the machine may be anywhere after it
LATE_NS = 500_000_000  # how far behind the newest reading one of another sensor may come
LATE_LIMIT = 200  # so many late readings in a row are a clock that was set back, not a late sensor
WHEELS = ("encoder", "odometry")
_stamp = attrgetter("stamp_ns")


class Decision(Enum):
    """What to do with a reading."""

    ACCEPT = "accept"
    REFUSE = "refuse"
    RESTART = "restart"  # accept it, and forget all before it


def by_stamp(readings: Iterable[Reading]) -> Iterator[list[Reading]]:
    """Readings in the order of their stamps, those of each stamp together and in an order of their own.

    Wheels come last, as what they roll is turned and freed of slip by the others; then the sensors' names decide.
    """
    ordered = sorted(readings, key=lambda r: (r.stamp_ns, r.kind in WHEELS, r.sensor))
    return (list(group) for _, group in groupby(ordered, key=_stamp))


class StreamOrder:
    """Gathers and decides on the readings of one machine; `counters` holds refusals and restarts by reason."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._held: dict[str, Reading] = {}  # of one time, by sensor
        self._held_ns = 0
        self._newest_ns = 0
        self._by_sensor: dict[str, int] = {}
        self._late_in_a_row = 0

    def gather(self, reading: Reading, known_ns: int) -> list[Reading]:
        """Hold a reading until one of another time comes: only then all of its time are there. Returns those.

        known_ns: when the machine had it. So a step of the filter waits for the next reading of any sensor, and results
        depend neither on the order of sensors nor on how a stream is cut into bundles.
        """
        ended = self.rest() if known_ns != self._held_ns else []
        self._held_ns = known_ns
        if reading.sensor in self._held:
            self.counters["reading_duplicate"] += 1
        else:
            self._held[reading.sensor] = reading
        return ended

    def rest(self) -> list[Reading]:
        """The readings that are held, as the stream ends."""
        held, self._held, self._held_ns = list(self._held.values()), {}, 0
        return held

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
