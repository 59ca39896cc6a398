"""What receivers report in any format: bytes to frames to messages. Pure.

A message has its sender's time, UTC or sensor ticks, never the host's.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from protocol.units import DAY_NS

TIME = "time"  # stream of the time alone, as early as known
FIX, VELOCITY, HEADING, IMU, WHEELS = "fix", "velocity", "heading", "imu", "wheels"
# Kinds of readings by stream.
STREAMS = {FIX: "gps", VELOCITY: "gps_velocity", HEADING: "attitude", IMU: "imu", WHEELS: "encoder"}
NO_TILT_RAD2 = 100.0  # roll and pitch of a heading: the largest allowed variance
WEEK_NS = 7 * DAY_NS
# Receivers count weeks in 10 bits, so old ones state a time 1024 or 2048 weeks ago: before 2019-04-07, the last
# rollover. Valid until 2038-11.
EARLIEST_NS = 1_554_595_200 * 10**9


class Message(NamedTuple):
    """One message.

    source: sender on a shared line (NMEA talker, gpsd device), else empty. utc_ns: when measured, 0 if unstated;
    tag_ns: the same by sensor ticks. values: columns of a reading, NaN for unstated variances; empty without a fix.
    quality, satellites: of a fix.
    """

    stream: str
    source: str
    utc_ns: int
    values: tuple[float, ...] = ()
    tag_ns: int | None = None
    quality: str = ""
    satellites: int = 0


class Decoder(Protocol):
    """Frames of one format to messages; keeps context between frames."""

    def decode(self, frame: bytes, host_ns: int) -> Sequence[Message]:
        """Messages of a whole frame that came at `host_ns`; ValueError if malformed."""


def variance(std: float) -> float:
    """NaN for 0 or less, which receivers state while their accuracy is unknown."""
    return std * std if std > 0 else math.nan


def velocity(speed_mps: float, course_rad: float, std_mps: float) -> tuple[float, ...]:
    """Velocity values by speed and course, clockwise from north."""
    east_north = speed_mps * math.sin(course_rad), speed_mps * math.cos(course_rad)
    return *east_north, variance(std_mps), variance(std_mps)


def heading(heading_rad: float, std_rad: float) -> tuple[float, ...]:
    """Attitude values by heading, clockwise from north; yaw is counter-clockwise from east."""
    half_yaw = (math.pi / 2 - heading_rad) / 2
    return 0.0, 0.0, math.sin(half_yaw), math.cos(half_yaw), NO_TILT_RAD2, NO_TILT_RAD2, variance(std_rad)


def rolled_over(utc_ns: int) -> int:
    """The true time of a receiver whose week count rolled over."""
    return utc_ns + max(0, -(-(EARLIEST_NS - utc_ns) // (1024 * WEEK_NS))) * 1024 * WEEK_NS


def wrapped(difference: int, period: int) -> int:
    """Difference of counter values modulo `period`, nearest to zero."""
    return (difference + period // 2) % period - period // 2
