"""Speed over ground by GPS receivers: what stands in for wheels that a machine does not have, or that say nothing.

It comes from Doppler velocities, else from differences of fixes. A receiver shows how its antenna moves over ground,
and neither where the machine points nor whether it reverses. But a machine moves along its own axis, so with v the
velocity of the antenna, w the turn rate, r the antenna's place, all complex, and psi the heading,

    v exp(-i psi) - i w r = speed ahead

The first motion is taken for one ahead, unless wheels said otherwise. From then on the turn sensor leads psi, and the
velocities correct it, modulo half a turn. Without a turn sensor the velocities alone lead it.
"""

import cmath
import math
from dataclasses import dataclass

from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Gps, GpsVelocity

MIN_VELOCITY_STD_MPS = 0.05  # receivers smooth their velocity, and state less than its error
MIN_FIX_STD_M = 0.3  # and so of fixes; one whose std is configured may be better
MOVED_SIGMA = 3.0  # a slower speed may be none
MIN_SPAN_S, MAX_SPAN_S = 0.9, 6.0  # between two fixes that make a velocity: they are further apart where little moves
FRESH_NS = 2_000_000_000  # after so long without Doppler velocities the fixes count
ROLLING_MPS = 0.3  # wheels that are slower do not show whether the machine reverses
STILL_STD_MPS = 0.1  # of a speed that shows a standstill; a less certain one may hide a turn
AGREES = 0.5  # cosine between the first two velocities, which show the way ahead together
GAIN = 0.1  # of the heading's correction by one velocity, after the first few
M_PER_DEG = 111_200.0  # of latitude, within half a percent; fixes a few seconds apart need no more


@dataclass(frozen=True)
class GroundSpeed:
    """Speed of `base_link` ahead, as known at stamp_ns: the mean around middle_ns.

    turned_rad: what the machine has turned since the last one, where no sensor shows it.
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
        """Whether it is hardly anything but zero."""
        return not self.moves and self.std_mps <= STILL_STD_MPS


@dataclass(frozen=True)
class _Velocity:
    """Velocity of an antenna, east + i north [m/s], its standard deviation, and how long it is the mean of."""

    mps: complex
    std_mps: float
    span_s: float


class GroundTracker:
    """Speeds ahead from the readings of all receivers. turns: whether a sensor shows the turn."""

    def __init__(self, *, turns: bool) -> None:
        self._turns = turns
        self._anchors: dict[str, tuple[int, complex]] = {}  # stamp and place of the fix to compare with
        self._newest: dict[str, complex] = {}
        self._doppler_ns = 0
        self._offset_rad = 0.0  # heading in `map` less the angle of dead reckoning
        self._corrections = 0  # of it so far
        self._last: GroundSpeed | None = None
        self._last_rad = self._rate_radps = 0.0  # angle then, and turn rate since the one before

    def update(
        self, reading: Gps | GpsVelocity, sensor: SensorConfig, angle_rad: float, wheels_mps: float | None = None
    ) -> GroundSpeed | None:
        """The speed that a reading shows; None where it shows none, or comes late.

        angle_rad: of dead reckoning. wheels_mps: speed by the wheels, None where they are silent.
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
        heading_rad = self._offset_rad + angle_rad - self._rate_radps * velocity.span_s / 2  # in the middle of the span
        x_m, y_m, _ = sensor.mount.xyz_m
        body = velocity.mps * cmath.exp(-1j * heading_rad) - 1j * self._rate_radps * complex(x_m, y_m)
        off_rad = cmath.phase(body * math.copysign(1.0, forced or body.real))
        self._corrections += abs(body) > least_mps
        turned_rad = self._correct(off_rad, rolls=wheels_mps is not None) if abs(body) > least_mps else 0.0
        ahead_mps = body.real if self._corrections else 0.0  # without a way ahead hardly anything moves
        middle_ns = reading.stamp_ns - round(velocity.span_s * 0.5e9)
        self._last = GroundSpeed(reading.stamp_ns, middle_ns, ahead_mps, velocity.std_mps, turned_rad)
        self._last_rad = angle_rad + turned_rad
        return self._last

    def face(self, offset_rad: float) -> None:
        """Correct the heading in `map` less the angle of dead reckoning."""
        self._offset_rad = offset_rad

    def turn_round(self) -> None:
        """Take the first motion for one in reverse."""
        self._offset_rad += math.pi
        self._last = None

    def _begin(self, mps: complex, angle_rad: float, *, reverses: bool) -> None:
        """Take a velocity for the way ahead; noise of fixes, which may have come before, turns back."""
        shown_rad = cmath.phase(mps) - angle_rad + math.pi * reverses
        if not self._corrections or math.cos(shown_rad - self._offset_rad) < AGREES:
            self._offset_rad, self._corrections = shown_rad, 0

    def _correct(self, off_rad: float, *, rolls: bool) -> float:
        """Turn the heading by what the motion is off; returns what dead reckoning over ground has to turn instead."""
        if not (self._turns or rolls):
            return off_rad
        self._offset_rad += off_rad * (max(1 / self._corrections, GAIN) if self._turns else 1.0)
        return 0.0

    def _doppler(self, reading: GpsVelocity, sensor: SensorConfig) -> _Velocity:
        self._doppler_ns = reading.stamp_ns
        variance = sum(velocity_variances(reading, sensor)) / 2
        return _Velocity(complex(reading.velocity_e_mps, reading.velocity_n_mps), math.sqrt(variance), 0.0)

    def _between(self, fix: Gps, sensor: SensorConfig) -> _Velocity | None:
        """Between two fixes: as soon as they are further apart than by noise, or late. A repeated one says nothing."""
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
    """Variances east and north: those that are configured, else the receiver's own, with a least value."""
    if "velocity" in sensor.std:
        return (sensor.std["velocity"] ** 2,) * 2
    return max(reading.var_e_m2ps2, MIN_VELOCITY_STD_MPS**2), max(reading.var_n_m2ps2, MIN_VELOCITY_STD_MPS**2)


def moved_variance(fix: Gps, sensor: SensorConfig, span_s: float) -> float:
    """Variance per axis of the way between two fixes [m2]: white noise of both, and how the slow error changes."""
    stated = max((fix.var_e_m2 + fix.var_n_m2) / 2, MIN_FIX_STD_M**2)
    variance = sensor.std["position"] ** 2 if "position" in sensor.std else stated
    slow = sensor.drift_share * -math.expm1(-span_s / sensor.drift_time_s)
    return 2 * variance * (1 - sensor.drift_share + slow)
