"""Order of readings by their stamps: those of one stamp belong together, late and astray ones are refused."""

from collections import Counter
from collections.abc import Iterable, Iterator
from enum import Enum
from itertools import groupby
from operator import attrgetter

from protocol.machine.clock_watch import ClockWatch
from protocol.machine.readings import Reading

LATE_NS = 500_000_000  # how far behind the newest reading one of another sensor may come
APART = 10  # refused readings in a row of one sensor: its clock is not that of the others
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
        self._clock = ClockWatch[None](LATE_NS)
        self._by_sensor: dict[str, int] = {}
        self._refused: dict[str, tuple[int, int]] = {}  # of sensors whose last reading was: how many, and its lead

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

    @property
    def clocks_s(self) -> dict[str, float]:
        """By how much sensors are ahead of those that count [s], where some are refused for that; else empty."""
        apart = {name: ahead_ns * 1e-9 for name, (n, ahead_ns) in self._refused.items() if n > APART}
        return {**dict.fromkeys(self._by_sensor, 0.0), **apart} if apart else {}

    def decide(self, reading: Reading) -> Decision:
        """Decide on one reading, and count it if it is not simply accepted.

        A pause of all sensors ends dead reckoning, as a clock that was set does: the machine may be anywhere after it.
        """
        stamp, last = reading.stamp_ns, self._by_sensor.get(reading.sensor, 0)
        ahead_ns = stamp - self._clock.newest_ns
        if not self._clock.goes_on(stamp):
            if self._clock.doubt(stamp, None)[0]:
                self.counters["gap_restarts" if ahead_ns > 0 else "clock_back_restarts"] += 1
                self._by_sensor, self._refused = {reading.sensor: stamp}, {}
                return Decision.RESTART
            self._refused[reading.sensor] = self._refused.get(reading.sensor, (0, 0))[0] + 1, ahead_ns
            self.counters["reading_ahead" if ahead_ns > 0 else "reading_late"] += 1
            return Decision.REFUSE
        if stamp <= last:
            self.counters["reading_duplicate" if stamp == last else "reading_late"] += 1
            return Decision.REFUSE
        self._clock.count(stamp)
        self._by_sensor[reading.sensor] = stamp
        if self._refused:
            self._refused.pop(reading.sensor, None)
        return Decision.ACCEPT
