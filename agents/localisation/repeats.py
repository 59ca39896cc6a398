"""Fixes that repeat bit for bit while the wheels turn: a stuck receiver, or a table that holds values.

Receivers of parked machines may pin theirs.
"""

from collections import Counter
from dataclasses import dataclass

from protocol.machine.readings import Gps

MOVED_M = 0.1  # distance since a value's first occurrence, after which it is stale
LASTING_NS = 3_000_000_000  # a repeat this long is a fault


@dataclass(frozen=True)
class _Place:
    """Latitude and longitude [deg], with stamp and distance of their first occurrence."""

    place_deg: tuple[float, float]
    stamp_ns: int
    distance_m: float


class Repeats:
    """Finds repeated fixes."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._first: dict[str, _Place] = {}
        self._lasting: dict[str, bool] = {}

    @property
    def lasting(self) -> list[str]:
        """Receivers stuck for over three seconds while the machine moved."""
        return [name for name, lasts in self._lasting.items() if lasts]

    def is_repeated(self, fix: Gps, distance_m: float) -> bool:
        """Whether a fix is a stale repeat; distance_m: wheel distance so far."""
        place_deg, first = (fix.lat_deg, fix.lon_deg), self._first.get(fix.sensor)
        if first is None or first.place_deg != place_deg:
            self._first[fix.sensor] = _Place(place_deg, fix.stamp_ns, distance_m)
            self._lasting[fix.sensor] = False
            return False
        if distance_m - first.distance_m < MOVED_M:
            return False
        self.counters[f"{fix.sensor}_repeated"] += 1
        self._lasting[fix.sensor] = fix.stamp_ns - first.stamp_ns > LASTING_NS
        return True
