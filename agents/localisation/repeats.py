"""Values of GPS that repeat bit for bit while the wheels turn: a receiver that hangs, or a table that holds each value.

A measured value has noise, so a repeat is no new one: it counts once. Receivers of parked machines may pin theirs.
"""

from collections import Counter
from dataclasses import dataclass

from protocol.machine.readings import Gps, GpsVelocity

MOVED_M = 0.1  # way since a value came first, from which on it cannot be true any more; a parked machine stays below
LASTING_NS = 3_000_000_000  # a receiver that repeats itself for so long has a fault


@dataclass(frozen=True)
class _Value:
    """A value, and stamp and way when it came first."""

    value: tuple[float, float]
    stamp_ns: int
    distance_m: float


class Repeats:
    """Finds repeated values."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._first: dict[str, _Value] = {}
        self._lasting: dict[str, bool] = {}

    @property
    def lasting(self) -> list[str]:
        """Names of sensors whose value has been the same for over three seconds while the machine moved."""
        return [name for name, lasts in self._lasting.items() if lasts]

    def is_repeated(self, reading: Gps | GpsVelocity, distance_m: float) -> bool:
        """Whether a reading says again what was true before; distance_m: way of the wheels so far."""
        if isinstance(reading, Gps):
            value = reading.lat_deg, reading.lon_deg
        else:
            value = reading.velocity_e_mps, reading.velocity_n_mps
        first = self._first.get(reading.sensor)
        if first is None or first.value != value:
            self._first[reading.sensor] = _Value(value, reading.stamp_ns, distance_m)
            self._lasting[reading.sensor] = False
            return False
        if distance_m - first.distance_m < MOVED_M:
            return False
        self.counters[f"{reading.sensor}_repeated"] += 1
        self._lasting[reading.sensor] = reading.stamp_ns - first.stamp_ns > LASTING_NS
        return True
