"""Speed over ground by GPS, in place of missing or silent wheels.

It comes from Doppler velocities, else differences of fixes. A receiver shows its antenna's motion, neither heading nor
reverse. But a machine moves along its axis. With antenna velocity v, turn rate w, antenna r, all complex, heading psi:

    v exp(-i psi) - i w r = speed ahead

The first motion counts as ahead, unless wheels deny it. Then the turn sensor drives psi, corrected by velocities modulo
half a turn; without one, velocities alone drive it.
"""

import cmath
import math
from dataclasses import dataclass

from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Gps, GpsVelocity

MIN_VELOCITY_STD_MPS = 0.05  # floor: receivers smooth, and understate errors
MIN_FIX_STD_M = 0.3  # floor of fixes, unless configured
MOVED_SIGMA = 3.0  # deviations below which a speed may be zero
MIN_SPAN_S, MAX_SPAN_S = 0.9, 6.0  # span of two fixes that make a velocity
FRESH_NS = 2_000_000_000  # time without Doppler after which fixes count
ROLLING_MPS = 0.3  # slower wheels do not show reverse
STILL_STD_MPS = 0.1  # deviation of a speed that shows standstill
AGREES = 0.5  # cosine of the first two velocities, which show ahead together
GAIN = 0.1  # gain of one velocity on the heading, after the first few
M_PER_DEG = 111_200.0  # of latitude, within 0.5 %; enough for fixes seconds apart


@dataclass(frozen=True)
class GroundSpeed:
    """Speed of `base_link` ahead, known at stamp_ns, the mean around middle_ns.

    turned_rad: turn since the last one, without a turn sensor.
    """

    stamp_ns: int
    middle_ns: int
    speed_mps: float
    std_mps: float
    turned_rad: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether it is certainly not zero."""
        return abs(self.speed_mps) > MOVED_SIGMA * self.std_mps

    @property
    def stands(self) -> bool:
        """Whether it is practically zero."""
        return not self.moves and self.std_mps <= STILL_STD_MPS


@dataclass(frozen=True)
class _Velocity:
    """Antenna velocity, east + i north [m/s], deviation, and averaging time."""

    mps: complex
    std_mps: float
    span_s: float


class GroundTracker:
    """Speeds ahead by all receivers. turns: whether a sensor shows the turn."""

    def __init__(self, *, turns: bool) -> None:
        self._turns = turns
        self._anchors: dict[str, tuple[int, complex]] = {}  # stamp and place of the fix to compare with
        self._newest: dict[str, complex] = {}
        self._doppler_ns = 0
        self._offset_rad = 0.0  # heading in `map` less dead reckoning's angle
        self._corrections = 0
        self._last: GroundSpeed | None = None
        self._last_rad = self._rate_radps = 0.0  # angle then, and turn rate since the one before

    def update(
        self, reading: Gps | GpsVelocity, sensor: SensorConfig, angle_rad: float, wheels_mps: float | None = None
    ) -> GroundSpeed | None:
        """The speed a reading shows; None if it shows none or is late.

        angle_rad: of dead reckoning. wheels_mps: by wheels, None while silent.
        """
        velocity = (
            self._doppler(reading, sensor) if isinstance(reading, GpsVelocity) else self._between(reading, sensor)
        )
        if velocity is None or (self._last and reading.stamp_ns < self._last.stamp_ns):
            return None
        forced = wheels_mps if wheels_mps and abs(wheels_mps) > ROLLING_MPS else 0.0
        least_mps = MOVED_SIGMA * velocity.std_mps
        if self._corrections < 2 and abs(velocity.mps) > least_mps:
            self._begin(velocity.mps, angle_rad, reverses=forced < 0)
        if self._last and reading.stamp_ns > self._last.stamp_ns:
            self._rate_radps = (angle_rad - self._last_rad) / (reading.stamp_ns - self._last.stamp_ns) * 1e9
        heading_rad = self._offset_rad + angle_rad - self._rate_radps * velocity.span_s / 2  # mid-span
        x_m, y_m, _ = sensor.mount.xyz_m
        body = velocity.mps * cmath.exp(-1j * heading_rad) - 1j * self._rate_radps * complex(x_m, y_m)
        off_rad = cmath.phase(body * math.copysign(1.0, forced or body.real))
        self._corrections += abs(body) > least_mps
        turned_rad = self._correct(off_rad, rolls=wheels_mps is not None) if abs(body) > least_mps else 0.0
        ahead_mps = body.real if self._corrections else 0.0  # without a known direction hardly anything moves
        middle_ns = reading.stamp_ns - round(velocity.span_s * 0.5e9)
        self._last = GroundSpeed(reading.stamp_ns, middle_ns, ahead_mps, velocity.std_mps, turned_rad)
        self._last_rad = angle_rad + turned_rad
        return self._last

    def face(self, offset_rad: float) -> None:
        """Set the heading in `map` less dead reckoning's angle."""
        self._offset_rad = offset_rad

    def turn_round(self) -> None:
        """Reinterpret the first motion as reverse."""
        self._offset_rad += math.pi
        self._last = None

    def _begin(self, mps: complex, angle_rad: float, *, reverses: bool) -> None:
        shown_rad = cmath.phase(mps) - angle_rad + math.pi * reverses
        if not self._corrections or math.cos(shown_rad - self._offset_rad) < AGREES:
            self._offset_rad, self._corrections = shown_rad, 0

    def _correct(self, off_rad: float, *, rolls: bool) -> float:
        """Correct the heading; returns the turn that dead reckoning has to make instead."""
        if not (self._turns or rolls):
            return off_rad
        self._offset_rad += off_rad * (max(1 / self._corrections, GAIN) if self._turns else 1.0)
        return 0.0

    def _doppler(self, reading: GpsVelocity, sensor: SensorConfig) -> _Velocity:
        self._doppler_ns = reading.stamp_ns
        variance = sum(velocity_variances(reading, sensor)) / 2
        return _Velocity(complex(reading.velocity_e_mps, reading.velocity_n_mps), math.sqrt(variance), 0.0)

    def _between(self, fix: Gps, sensor: SensorConfig) -> _Velocity | None:
        """Velocity between fixes, once apart beyond noise or late; repeats are ignored."""
        place = complex(fix.lon_deg * math.cos(math.radians(fix.lat_deg)), fix.lat_deg) * M_PER_DEG
        begin_ns, begin = self._anchors.setdefault(sensor.name, (fix.stamp_ns, place))
        span_s, is_repeated = (fix.stamp_ns - begin_ns) * 1e-9, place == self._newest.get(sensor.name)
        self._newest[sensor.name] = place
        if span_s < MIN_SPAN_S or is_repeated:
            return None
        std_m = math.sqrt(moved_variance(fix, sensor, span_s))
        if abs(place - begin) <= MOVED_SIGMA * std_m and span_s < MAX_SPAN_S:
            return None
        self._anchors[sensor.name] = fix.stamp_ns, place
        is_asked = fix.stamp_ns - self._doppler_ns > FRESH_NS and span_s < 2 * MAX_SPAN_S
        return _Velocity((place - begin) / span_s, std_m / span_s, span_s) if is_asked else None


def velocity_variances(reading: GpsVelocity, sensor: SensorConfig) -> tuple[float, float]:
    """Variances east and north: configured, else the receiver's with a floor."""
    if "velocity" in sensor.std:
        return (sensor.std["velocity"] ** 2,) * 2
    return max(reading.var_e_m2ps2, MIN_VELOCITY_STD_MPS**2), max(reading.var_n_m2ps2, MIN_VELOCITY_STD_MPS**2)


def moved_variance(fix: Gps, sensor: SensorConfig, span_s: float) -> float:
    """Variance per axis of the displacement between fixes [m2]: white noise of both, change of the slow error."""
    stated = max((fix.var_e_m2 + fix.var_n_m2) / 2, MIN_FIX_STD_M**2)
    variance = sensor.std["position"] ** 2 if "position" in sensor.std else stated
    slow = sensor.drift_share * -math.expm1(-span_s / sensor.drift_time_s)
    return 2 * variance * (1 - sensor.drift_share + slow)
