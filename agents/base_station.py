"""A base station: receivers at a surveyed place, whose fixes show what GPS is off there. The pure core of its agent.

It states the error of each span as it is, with its white noise, and does not smooth it: who uses it has a filter, which
needs errors that are independent but for what their model says. What it adds is what only it knows, from all the time
that it has stood there: the part of its error that lasts, as of a wrong survey.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.ground_speed import MIN_FIX_STD_M
from agents.localisation.filters.motion import BASE_OFFSET_WALK
from agents.localisation.gps import MIN_DRIFT_M2
from agents.stream_order import Decision, StreamOrder
from protocol.arrays import Floats
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Correction, Gps, Reading
from protocol.site.site_config import Projection

SPAN_NS = 200_000_000  # one correction in so long, as soon as all receivers have spoken
SILENT_NS = 5_000_000_000  # a receiver without fixes for so long counts no more
FAR_M = 1000.0  # a fix further off is no fix of this place
PINNED = 25  # equal fixes in a row: a receiver that holds its place while it stands shows no error
OFFSET_STD_M = 3.0  # of the lasting error at first: a wrong survey is off by metres
GATE_SIGMA, RELOCK = 5.0, 25  # errors further off are not learnt from; so many in a row are a base that was moved
SURE = 3.0  # a lasting error of so many standard deviations, and of OFF_M, is reported
OFF_M = 1.0


@dataclass(frozen=True)
class _Fix:
    """What a fix is off (2,) [m], with the variances of an axis [m2]: white noise and slow error."""

    stamp_ns: int
    off_m: Floats
    white_m2: float
    slow_m2: float


class LastingError:
    """Splits the error of a base into a slow part b, which is zero on average, and a lasting one d; both axes alike.

    A Kalman filter of (b, d): b is a stationary Gauss-Markov process, d a slow random walk, error = b + d + noise.
    """

    def __init__(self) -> None:
        self._x: Floats = np.zeros((2, 2))  # of both axes
        self._P: Floats = np.zeros((2, 2))
        self._stamp_ns = self._refused = 0

    @property
    def offset_m(self) -> Floats:
        """The lasting error (2,)."""
        return self._x[:, 1]

    @property
    def variance_m2(self) -> float:
        """Of the lasting error, per axis."""
        return float(self._P[1, 1])

    def update(self, stamp_ns: int, off_m: Floats, white_m2: float, slow_m2: float, time_s: float) -> None:
        """Learn from the error at a later stamp."""
        if not self._stamp_ns:
            self._P = np.diag([slow_m2, OFFSET_STD_M**2])
        dt_s = max(stamp_ns - (self._stamp_ns or stamp_ns), 0) * 1e-9  # a clock may have been set back
        self._stamp_ns = stamp_ns
        fade = math.exp(-dt_s / time_s)
        self._x = self._x * [fade, 1.0]
        self._P = self._P * [[fade**2, fade], [fade, 1.0]]
        self._P += np.diag([slow_m2 * (1 - fade**2), BASE_OFFSET_WALK**2 * dt_s])
        y, Ph = off_m - self._x.sum(axis=1), self._P.sum(axis=1)
        S = float(Ph.sum()) + white_m2
        if float(y @ y) > 2 * GATE_SIGMA**2 * S:
            self._refused += 1
            if self._refused < RELOCK:
                return
            self._P[1, 1] += float(y @ y)
            Ph = self._P.sum(axis=1)
            S = float(Ph.sum()) + white_m2
        self._refused = 0
        self._x = self._x + np.outer(y, Ph / S)
        self._P = self._P - np.outer(Ph, Ph) / S


class BaseStation:
    """The receivers of one base; `place_m`: east and north of its `base_link` in `map`, whose axes point there too."""

    def __init__(
        self, name: str, sensors: Sequence[SensorConfig], place_m: tuple[float, float], projection: Projection
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._name, self._projection = name, projection
        self._sensors = {s.name: s for s in sensors if s.kind == Gps.kind and s.use}
        self._antennas = {n: np.array(place_m) + s.mount.xyz_m[:2] for n, s in self._sensors.items()}
        self._order = StreamOrder()
        self._span: dict[str, _Fix] = {}  # the first fix of each receiver
        self._span_number, self._is_said = 0, False
        self._heard_ns: dict[str, int] = {}
        self._last: dict[str, tuple[float, float]] = {}
        self._pinned: Counter[str] = Counter()
        self._lasting = LastingError()

    def step(self, readings: Sequence[Reading]) -> list[Correction]:
        """Take in readings in the order of their stamps; returns the corrections of the spans that they complete."""
        return [correction for reading in readings if (correction := self._take(reading))]

    def health(self) -> dict[str, Any]:
        """State in plain values."""
        offset_m, std_m = self._lasting.offset_m, math.sqrt(self._lasting.variance_m2)
        return {
            "receivers": len(self._heard_ns),
            "offset_m": [round(float(v), 2) for v in offset_m],
            "offset_std_m": round(std_m, 2),
            "counters": dict(self.counters + self._order.counters),
            "problem": self.problem,
        }

    @property
    def problem(self) -> str:
        """What an operator should mend; empty where nothing is known."""
        if pinned := [name for name, count in self._pinned.items() if count >= PINNED]:
            return f"fixes of {pinned[0]} stand still: turn off the static hold of the receiver"
        off_m, std_m = float(np.hypot(*self._lasting.offset_m)), math.sqrt(self._lasting.variance_m2)
        if off_m > max(SURE * std_m, OFF_M):
            e, n = self._lasting.offset_m
            where = f"{e:+.1f} m east, {n:+.1f} m north"
            return f"fixes are {off_m:.1f} m ({where}) from the surveyed place on average: check `place`"
        return ""

    def _take(self, reading: Reading) -> Correction | None:
        fix = self._fix(reading)
        if fix is None:
            return None
        if not self._heard_ns:  # at first all receivers are waited for
            self._heard_ns = dict.fromkeys(self._sensors, fix.stamp_ns)
        if fix.stamp_ns // SPAN_NS != self._span_number:
            self._span, self._span_number, self._is_said = {}, fix.stamp_ns // SPAN_NS, False
        self._heard_ns[reading.sensor] = fix.stamp_ns
        self._heard_ns = {n: ns for n, ns in self._heard_ns.items() if fix.stamp_ns - ns < SILENT_NS}
        self._span.setdefault(reading.sensor, fix)
        if self._is_said or set(self._span) != set(self._heard_ns):
            return None
        self._is_said = True
        return self._correction(list(self._span.values()))

    def _fix(self, reading: Reading) -> _Fix | None:
        """What a fix is off; None of a reading that does not count."""
        sensor = self._sensors.get(reading.sensor)
        if sensor is None or not isinstance(reading, Gps):
            self.counters["reading_unknown_sensor"] += 1
            return None
        decision = self._order.decide(reading)
        if decision is Decision.REFUSE:
            return None
        if decision is Decision.RESTART:
            self._heard_ns = {}  # what it learnt of its lasting error stays
        place = reading.lat_deg, reading.lon_deg
        self._pinned[sensor.name] = self._pinned[sensor.name] + 1 if self._last.get(sensor.name) == place else 0
        self._last[sensor.name] = place
        if self._pinned[sensor.name] >= PINNED:
            self.counters["fix_pinned"] += 1
            return None
        x, y, _ = self._projection.to_map(reading.lat_deg, reading.lon_deg, reading.height_m)
        off_m = np.array([x, y]) - self._antennas[sensor.name]
        if not float(np.abs(off_m).max()) < FAR_M:
            self.counters["fix_far_off"] += 1
            return None
        stated_m2 = (
            sensor.std["position"] ** 2 if "position" in sensor.std else (reading.var_e_m2 + reading.var_n_m2) / 2
        )
        least_m2 = MIN_DRIFT_M2 if "position" in sensor.std else MIN_FIX_STD_M**2
        white_m2 = max((1 - sensor.drift_share) * stated_m2, least_m2)
        return _Fix(reading.stamp_ns, off_m, white_m2, max(sensor.drift_share * stated_m2, MIN_DRIFT_M2))

    def _correction(self, fixes: Sequence[_Fix]) -> Correction:
        """The mean of one fix of each receiver. What is slow in them they are taken to have in common."""
        n = len(fixes)
        stamp_ns = fixes[0].stamp_ns + sum(f.stamp_ns - fixes[0].stamp_ns for f in fixes) // n
        off_m = sum((f.off_m for f in fixes), np.zeros(2)) / n
        white_m2, slow_m2 = sum(f.white_m2 for f in fixes) / n**2, sum(f.slow_m2 for f in fixes) / n
        time_s = min(self._sensors[name].drift_time_s for name in self._span)
        self._lasting.update(stamp_ns, off_m, white_m2, slow_m2, time_s)
        self.counters["corrections"] += 1
        (east_m, north_m), (offset_e_m, offset_n_m) = off_m.tolist(), self._lasting.offset_m.tolist()
        offset = offset_e_m, offset_n_m, self._lasting.variance_m2
        return Correction(self._name, stamp_ns, east_m, north_m, white_m2, slow_m2, time_s, *offset)
