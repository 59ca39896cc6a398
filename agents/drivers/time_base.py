"""One time base: the host's monotonic clock, tied to UTC by receivers. Pure; steps of the host's UTC do not matter.

Messages come late, never early. So the greatest difference of another clock to the host's at arrival, within a minute,
has the least delay: it ties the clocks.
"""

from collections import Counter

WINDOW_NS = 30 * 10**9  # half a tie's window; a drift of 20 ppm is 1 ms then
APART_NS = 10**9  # larger differences mean another time, as by leap seconds; no working link is so late
STEADY_NS = 3 * 10**9  # time after which a clock counts as set, not its line as held up


class ClockTie:
    """Lead of another clock over the host's. offset_ns: None before the first message. steps: times it was set."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None
        self.heard_ns = 0
        self.steps = 0
        self._greatest = (0, 0)  # of the last and the current window
        self._end_ns = 0
        self._doubted = (0, 0)  # another offset, and its first time

    def take(self, theirs_ns: int, host_ns: int) -> bool:
        """Add their time in a message at `host_ns`; returns whether it continues those before."""
        ahead_ns = theirs_ns - host_ns
        is_same = self.offset_ns is not None and abs(ahead_ns - self.offset_ns) <= APART_NS
        if not is_same and not self._is_set(ahead_ns, host_ns):
            return False
        last_ns, greatest_ns = self._greatest if is_same else (ahead_ns, ahead_ns)
        if not is_same or host_ns > self._end_ns:
            last_ns, greatest_ns, self._end_ns = greatest_ns, ahead_ns, host_ns + WINDOW_NS
        self._greatest = last_ns, max(greatest_ns, ahead_ns)
        self._doubted, self.heard_ns, self.offset_ns = (0, 0), host_ns, max(self._greatest)
        return True

    def _is_set(self, ahead_ns: int, host_ns: int) -> bool:
        if self.offset_ns is None:
            return True
        if not self._doubted[1] or abs(ahead_ns - self._doubted[0]) > APART_NS:
            self._doubted = ahead_ns, host_ns
        is_set = host_ns - self._doubted[1] > STEADY_NS
        self.steps += is_set
        return is_set


class TimeBase:
    """UTC by the host's monotonic clock. `counters`: refused stamps, set clocks."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._ties: dict[str, ClockTie] = {}
        self._ahead_ns: int | None = None  # by the receiver of least delay, for all values

    def take(self, clock: str, utc_ns: int, host_ns: int) -> None:
        """Add a receiver's UTC in a message at `host_ns`."""
        tie = self._ties.setdefault(clock, ClockTie())
        tie.take(utc_ns, host_ns)
        offsets = list(self._offsets().values())
        self._ahead_ns = max(ns for ns in offsets if abs(ns - offsets[0]) <= APART_NS)
        self.counters["clock_set"] = sum(tie.steps for tie in self._ties.values())

    def believes(self, utc_ns: int, host_ns: int) -> bool:
        """Whether a message's UTC agrees with the base; the first clock counts."""
        known_ns = self.utc_ns(host_ns)
        is_believed = known_ns is not None and abs(utc_ns - known_ns) <= APART_NS
        self.counters["stamp_refused"] += not is_believed
        return is_believed

    @property
    def apart_s(self) -> dict[str, float]:
        """Receivers with another time, and their lead [s]."""
        offsets = self._offsets()
        first_ns = next(iter(offsets.values()), 0)
        return {name: (ns - first_ns) * 1e-9 for name, ns in offsets.items() if abs(ns - first_ns) > APART_NS}

    def utc_ns(self, host_ns: int) -> int | None:
        """UTC at a host time, by the receiver of least delay; None before any."""
        return None if self._ahead_ns is None else host_ns + self._ahead_ns

    def _offsets(self) -> dict[str, int]:
        """Of clocks still heard, the authoritative one first."""
        newest_ns = max((tie.heard_ns for tie in self._ties.values()), default=0)
        ties = {name: tie for name, tie in self._ties.items() if newest_ns - tie.heard_ns <= 2 * WINDOW_NS}
        return {name: tie.offset_ns for name, tie in ties.items() if tie.offset_ns is not None}
