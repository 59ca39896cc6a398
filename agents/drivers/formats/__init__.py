"""What receivers report, whatever their format: bytes become frames, frames become messages. Pure.

A message has its own time where its sender has a clock: UTC, or the ticks of a sensor. It never has the host's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

NO_FIX = "no fix"  # the quality of a fix without a place
WEEK_NS = 7 * 86_400 * 10**9
# A receiver counts weeks in 10 bits, so an old one states a time 1024 weeks ago, or twice that: before 2019-04-07, when
# the count began again last. This holds until 2038-11.
EARLIEST_NS = 1_554_595_200 * 10**9


@dataclass(frozen=True, slots=True)
class Message:
    """One message. source: who sent it where several share a line (NMEA's talker, gpsd's device), else empty.

    utc_ns: when it was true, 0 where the sender does not state it. A message of this class itself shows the time alone,
    as early as it can be known.
    """

    stream: ClassVar[str] = ""  # as [[driver]] names what a sensor is fed by
    kind: ClassVar[str] = ""  # of the readings that it makes

    source: str
    utc_ns: int

    def values(self, _: Mapping[str, float]) -> tuple[float, ...]:
        """Values of a reading of its kind, by the sensor's `std` where the sender states no accuracy."""
        return ()


@dataclass(frozen=True, slots=True)
class Fix(Message):
    """A place, WGS 84, or that there is none. std_m: east, north, up; NaN where not stated."""

    stream: ClassVar[str] = "fix"
    kind: ClassVar[str] = "gps"

    quality: str
    satellites: int
    lat_deg: float = math.nan
    lon_deg: float = math.nan
    height_m: float = math.nan
    std_m: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    def values(self, std: Mapping[str, float]) -> tuple[float, ...]:
        """Columns of a `Gps`."""
        east, north, up = (_square(value, std.get("position")) for value in self.std_m)
        return self.lat_deg, self.lon_deg, self.height_m, east, north, up


@dataclass(frozen=True, slots=True)
class Velocity(Message):
    """Velocity over ground by Doppler shift. std_mps: of each component, NaN where not stated."""

    stream: ClassVar[str] = "velocity"
    kind: ClassVar[str] = "gps_velocity"

    east_mps: float
    north_mps: float
    std_mps: float

    def values(self, std: Mapping[str, float]) -> tuple[float, ...]:
        """Columns of a `GpsVelocity`."""
        variance = _square(self.std_mps, std.get("velocity"))
        return self.east_mps, self.north_mps, variance, variance


@dataclass(frozen=True, slots=True)
class Heading(Message):
    """Heading of the x axis of a pair of antennas [rad], clockwise from north, with its standard deviation."""

    stream: ClassVar[str] = "heading"
    kind: ClassVar[str] = "attitude"
    tilt_var_rad2: ClassVar[float] = 100.0  # roll and pitch are not measured: the highest variance of a reading

    heading_rad: float
    std_rad: float

    def values(self, std: Mapping[str, float]) -> tuple[float, ...]:
        """Columns of an `Attitude`; yaw is counter-clockwise from east."""
        half_yaw = (math.pi / 2 - self.heading_rad) / 2
        variance = _square(self.std_rad, std.get("heading"))
        return 0.0, 0.0, math.sin(half_yaw), math.cos(half_yaw), self.tilt_var_rad2, self.tilt_var_rad2, variance


@dataclass(frozen=True, slots=True)
class Tagged(Message):
    """Message of a sensor with a clock of its own. tag_ns: its time, from an unknown start."""

    tag_ns: int
    measured: tuple[float, ...]

    def values(self, _: Mapping[str, float]) -> tuple[float, ...]:
        """As they are: columns of a reading of its kind."""
        return self.measured


@dataclass(frozen=True, slots=True)
class Inertial(Tagged):
    """Angular rate [rad/s] and specific force [m/s2] about and along x, y, z."""

    stream: ClassVar[str] = "imu"
    kind: ClassVar[str] = "imu"


@dataclass(frozen=True, slots=True)
class WheelTicks(Tagged):
    """Ticks of the left and the right wheel, counted up from start, down in reverse."""

    stream: ClassVar[str] = "wheels"
    kind: ClassVar[str] = "encoder"


STREAMS = {cls.stream: cls.kind for cls in (Fix, Velocity, Heading, Inertial, WheelTicks)}


class Decoder(Protocol):
    """Makes messages of the frames of one format; keeps what one frame says of the next."""

    def decode(self, frame: bytes, host_ns: int) -> Sequence[Message]:
        """Messages of a whole frame that came at `host_ns` of the host's clock; ValueError where it is malformed."""


def rolled_over(utc_ns: int) -> int:
    """The time that a receiver means whose count of weeks has rolled over."""
    return utc_ns + max(0, -(-(EARLIEST_NS - utc_ns) // (1024 * WEEK_NS))) * 1024 * WEEK_NS


def wrapped(difference: int, period: int) -> int:
    """A difference of two values of a counter that starts again after `period`: the one nearest to zero."""
    return (difference + period // 2) % period - period // 2


def _square(stated: float, otherwise: float | None) -> float:
    """Variance; receivers that do not know their accuracy state 0, or nothing."""
    std = stated if stated > 0 else (math.nan if otherwise is None else otherwise)
    return std * std
