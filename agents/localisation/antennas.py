"""Checks antenna mounts against the direction of driving. Pure.

On a straight stretch of course c,

    z = mean of exp(-i c) v conj(d) / |d|^2

is 1, and -1 for exchanged antennas; v: vector between two antennas in `map` by fixes, d: by mounts, all complex. A
heading is tested as exp(i yaw) with d = 1. The fixes' white error falls with their number, the slow part with driving
time over its correlation time.
"""

import cmath
import math
from collections import deque
from dataclasses import dataclass

from agents.dead_reckoning import WHEELS, DeadReckoning
from agents.localisation.headings import rpy_of_base
from protocol.machine.machine_config import ABSOLUTE, BASE, MachineConfig, SensorConfig
from protocol.machine.readings import Attitude, Gps, Reading
from protocol.site.site_config import Projection

STRETCH_M = 10.0  # gives a course within some degrees
STRAIGHT = 0.85  # least ratio of chord to distance
APART_M = 0.5  # least antenna distance, against reflections
GAP_NS = 1_500_000_000  # longest gap of fixes to interpolate
DUE_NS = 200_000_000  # interval of used headings
WRONG = 0.75  # bound of |z - 1|: 45 degrees, beyond bends or iron
SIGMA = 3.0
LEAST = 3  # stretches


@dataclass
class Trial:
    """Evidence on one vector. expected: by mounts. white, slow: variances of one value."""

    expected: complex = 1 + 0j
    white: float = 0.0
    slow: float = 0.0
    slow_s: float = 1.0
    shown: complex = 0j  # sum over this stretch
    n: int = 0
    total: complex = 0j  # sum of z over stretches
    stretches: int = 0
    values: int = 0
    driven_s: float = 0.0

    def finish(self, course: complex, seconds: float) -> None:
        """End a stretch of this course, a unit vector, or 0 for none."""
        if course and self.n:
            z = self.shown / self.n * course.conjugate() * self.expected.conjugate() / abs(self.expected) ** 2
            self.total += z
            self.stretches += 1
            self.values += self.n
            self.driven_s += seconds
        self.shown, self.n = 0j, 0

    @property
    def wrong(self) -> complex | None:
        """The mean z, if it certainly contradicts the mounts."""
        if self.stretches < LEAST:
            return None
        z = self.total / self.stretches
        slow = self.slow * min(1.0, 2 * self.slow_s / self.driven_s)
        std = math.sqrt((self.white / self.values + slow) / 2) / abs(self.expected)
        return z if abs(z - 1) > WRONG + SIGMA * std else None


class Antennas:
    """Compares a machine's antennas with its driving; not without wheels or accelerometer, which show ahead."""

    def __init__(self, machine: MachineConfig, projection: Projection) -> None:
        used = [s for s in machine.sensors if s.use and s.frame == BASE and s.mode == ABSOLUTE]
        knows_ahead = any(
            s.kind in WHEELS or (s.kind == "imu" and s.provides("force")) for s in machine.sensors if s.use
        )
        receivers = [s for s in used if s.kind == "gps"] if knows_ahead else []
        self._projection = projection
        self._reference = receivers[0] if receivers else None
        apart = {s.name: _place(s) - _place(receivers[0]) for s in receivers[1:]}
        self._trials = {name: Trial(d) for name, d in apart.items() if abs(d) >= APART_M}
        compasses = [s for s in used if s.kind == "attitude" and s.provides("heading")] if receivers else []
        self._base_from_sensor = {s.name: s.mount.frame_from_sensor() for s in compasses}
        self._trials |= {name: Trial() for name in self._base_from_sensor}
        self._track: deque[tuple[int, complex]] = deque(maxlen=2)  # newest fixes of the reference
        self._begin: tuple[int, complex, float, float] | None = None  # begin of the stretch: stamp, place, travel, way
        self._variance = (0.0, 0.0)  # of the reference: white and slow
        self._due_ns = dict.fromkeys(self._base_from_sensor, 0)

    @property
    def problems(self) -> dict[str, str]:
        """What is certainly wrong, a sentence by sensor."""
        wrong = {name: z for name, trial in self._trials.items() if (z := trial.wrong) is not None}
        return {name: self._sentence(name, z) for name, z in wrong.items()}

    def take(self, reading: Reading, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> None:
        """Add a reading, after dead reckoning; other sensors are ignored."""
        if not self._trials or self._reference is None:
            return
        if isinstance(reading, Gps) and sensor.name in (self._reference.name, *self._trials):
            self._fix(reading, sensor, dead_reckoning)
        elif isinstance(reading, Attitude) and reading.stamp_ns >= self._due_ns.get(sensor.name, math.inf):
            self._due_ns[sensor.name] = reading.stamp_ns + DUE_NS
            yaw = float(rpy_of_base(reading, self._base_from_sensor[sensor.name])[2])
            self._show(sensor.name, cmath.exp(1j * yaw))

    def restart(self) -> None:
        """Drop the stretch, as dead reckoning restarts."""
        self._finish(0j, 0)
        self._begin = None
        self._due_ns = dict.fromkeys(self._due_ns, 0)

    def _fix(self, fix: Gps, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> None:
        x, y, _ = self._projection.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
        std_m = sensor.std.get("position")
        variance = std_m * std_m if std_m else (fix.var_e_m2 + fix.var_n_m2) / 2
        white, slow = (1 - sensor.drift_share) * 2 * variance, sensor.drift_share * 2 * variance
        if sensor.name in self._trials:
            trial = self._trials[sensor.name]
            trial.white, trial.slow = white + self._variance[0], slow + self._variance[1]
            trial.slow_s = sensor.drift_time_s
            if (reference_m := self._reference_at(fix.stamp_ns)) is not None:
                self._show(sensor.name, complex(x, y) - reference_m)
            return
        self._variance = white, slow
        self._track.append((fix.stamp_ns, complex(x, y)))
        self._follow(fix.stamp_ns, complex(x, y), dead_reckoning)

    def _reference_at(self, stamp_ns: int) -> complex | None:
        """The reference's place by its two newest fixes; a bend shifts it by centimetres."""
        if len(self._track) < 2:
            return None
        (from_ns, from_m), (to_ns, to_m) = self._track
        if not 0 < to_ns - from_ns <= GAP_NS or abs(stamp_ns - to_ns) > GAP_NS:
            return None
        return to_m + (to_m - from_m) * (stamp_ns - to_ns) / (to_ns - from_ns)

    def _show(self, name: str, vector: complex) -> None:
        trial = self._trials[name]
        trial.shown += vector
        trial.n += 1

    def _follow(self, stamp_ns: int, place_m: complex, dead_reckoning: DeadReckoning) -> None:
        now = stamp_ns, place_m, dead_reckoning.travel_m, dead_reckoning.distance_m
        if self._begin is None or stamp_ns <= self._begin[0]:
            self._begin = now
            return
        begin_ns, begin_m, travel_m, distance_m = self._begin
        chord_m, ahead_m = place_m - begin_m, dead_reckoning.travel_m - travel_m
        driven_m = dead_reckoning.distance_m - distance_m
        if abs(chord_m) < STRETCH_M and driven_m < STRETCH_M / STRAIGHT:
            return
        is_straight = abs(chord_m) >= STRAIGHT * driven_m and abs(ahead_m) >= STRAIGHT * abs(chord_m)
        course = chord_m / abs(chord_m) * math.copysign(1.0, ahead_m) if is_straight else 0j
        self._finish(course, (stamp_ns - begin_ns) * 1e-9)
        self._begin = now

    def _finish(self, course: complex, seconds: float) -> None:
        for trial in self._trials.values():
            trial.finish(course, seconds)

    def _sentence(self, name: str, z: complex) -> str:
        is_round = z.real < -abs(z.imag)
        if name in self._base_from_sensor:
            off_deg = math.degrees(cmath.phase(z))
            turned = (
                f"points {abs(off_deg):.0f} deg to the {'left' if off_deg > 0 else 'right'} of where the machine drives"
            )
            return f"{turned}: {'exchange its two antennas, or' if is_round else ''} turn `rpy_deg` of its mount"
        assert self._reference is not None
        if is_round:
            other = self._reference.name
            return (
                f"and {other} sit the other way round than their mounts say: exchange their addresses, or their mounts"
            )
        seen, stated = z * self._trials[name].expected, self._trials[name].expected
        lies = f"{seen.real:.1f} m ahead and {seen.imag:.1f} m left of {self._reference.name}"
        return f"lies {lies}, by the mounts {stated.real:.1f} and {stated.imag:.1f}: measure both"


def _place(sensor: SensorConfig) -> complex:
    return complex(*sensor.mount.xyz_m[:2])
