"""Order of readings by stamp; late and stray ones are refused."""

from collections import Counter
from collections.abc import Iterable, Iterator
from enum import Enum
from itertools import groupby
from operator import attrgetter

from protocol.machine.clock_watch import ClockWatch
from protocol.machine.readings import Reading

LATE_NS = 500_000_000  # largest lateness behind another sensor's newest reading
APART = 10  # refusals in a row that show a different clock
WHEELS = ("encoder", "odometry")
_stamp = attrgetter("stamp_ns")


class Decision(Enum):
    """What to do with a reading."""

    ACCEPT = "accept"
    REFUSE = "refuse"
    RESTART = "restart"  # accept, and forget everything before


def by_stamp(readings: Iterable[Reading]) -> Iterator[list[Reading]]:
    """Readings grouped by stamp, in order.

    Wheels come last, as others turn their roll and remove its slip; then by sensor name.
    """
    ordered = sorted(readings, key=lambda r: (r.stamp_ns, r.kind in WHEELS, r.sensor))
    return (list(group) for _, group in groupby(ordered, key=_stamp))


class StreamOrder:
    """Gathers and judges one machine's readings; `counters`: refusals and restarts by reason."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._held: dict[str, Reading] = {}  # of one time, by sensor
        self._held_ns = 0
        self._clock = ClockWatch[None](LATE_NS)
        self._by_sensor: dict[str, int] = {}
        self._refused: dict[str, tuple[int, int]] = {}  # sensors whose last reading was refused: count and lead

    def gather(self, reading: Reading, known_ns: int) -> list[Reading]:
        """Hold a reading until one of another time arrives; returns the completed group.

        known_ns: time of arrival. So a filter step waits for the next reading, and results depend neither on the order
        of sensors nor on bundling.
        """
        ended = self.rest() if known_ns != self._held_ns else []
        self._held_ns = known_ns
        if reading.sensor in self._held:
            self.counters["reading_duplicate"] += 1
        else:
            self._held[reading.sensor] = reading
        return ended

    def rest(self) -> list[Reading]:
        """The held readings, at the end of the stream."""
        held, self._held, self._held_ns = list(self._held.values()), {}, 0
        return held

    @property
    def clocks_s(self) -> dict[str, float]:
        """Lead over the accepted sensors [s], if some are refused for it; else empty."""
        apart = {name: ahead_ns * 1e-9 for name, (n, ahead_ns) in self._refused.items() if n > APART}
        return {**dict.fromkeys(self._by_sensor, 0.0), **apart} if apart else {}

    def decide(self, reading: Reading) -> Decision:
        """Judge one reading; count it unless simply accepted.

        A pause of all sensors, or a clock change, ends dead reckoning: the machine may be anywhere.
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
