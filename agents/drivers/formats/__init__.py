"""What receivers report, whatever their format: bytes become frames, frames become messages. Pure.

A message has its own time where its sender has a clock: UTC, or the ticks of a sensor. It never has the host's.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from protocol.units import DAY_NS

TIME = "time"  # stream of messages that show the time alone, as early as it can be known
FIX, VELOCITY, HEADING, IMU, WHEELS = "fix", "velocity", "heading", "imu", "wheels"
# Kinds of the readings that they make.
STREAMS = {FIX: "gps", VELOCITY: "gps_velocity", HEADING: "attitude", IMU: "imu", WHEELS: "encoder"}
NO_TILT_RAD2 = 100.0  # roll and pitch of a heading: the highest variance that a reading may have
WEEK_NS = 7 * DAY_NS
# A receiver counts weeks in 10 bits, so an old one states a time 1024 weeks ago, or twice that: before 2019-04-07, when
# the count began again last. This holds until 2038-11.
EARLIEST_NS = 1_554_595_200 * 10**9


class Message(NamedTuple):
    """One message.

    source: who sent it where several share a line (NMEA's talker, gpsd's device), else empty. utc_ns: when it was true,
    0 where the sender does not state it; tag_ns: the same by a sensor's own ticks. values: columns of a reading, with
    NaN for a variance that is not stated; none of a fix that is none. quality, satellites: of a fix.
    """

    stream: str
    source: str
    utc_ns: int
    values: tuple[float, ...] = ()
    tag_ns: int | None = None
    quality: str = ""
    satellites: int = 0


class Decoder(Protocol):
    """Makes messages of the frames of one format; keeps what one frame says of the next."""

    def decode(self, frame: bytes, host_ns: int) -> Sequence[Message]:
        """Messages of a whole frame that came at `host_ns` of the host's clock; ValueError where it is malformed."""


def variance(std: float) -> float:
    """NaN where a receiver states 0 or nothing, as it does while it does not know its accuracy."""
    return std * std if std > 0 else math.nan


def velocity(speed_mps: float, course_rad: float, std_mps: float) -> tuple[float, ...]:
    """Values of a velocity by speed and course, clockwise from north."""
    east_north = speed_mps * math.sin(course_rad), speed_mps * math.cos(course_rad)
    return *east_north, variance(std_mps), variance(std_mps)


def heading(heading_rad: float, std_rad: float) -> tuple[float, ...]:
    """Values of an attitude by a heading, clockwise from north; yaw is counter-clockwise from east."""
    half_yaw = (math.pi / 2 - heading_rad) / 2
    return 0.0, 0.0, math.sin(half_yaw), math.cos(half_yaw), NO_TILT_RAD2, NO_TILT_RAD2, variance(std_rad)


def rolled_over(utc_ns: int) -> int:
    """The time that a receiver means whose count of weeks has rolled over."""
    return utc_ns + max(0, -(-(EARLIEST_NS - utc_ns) // (1024 * WEEK_NS))) * 1024 * WEEK_NS


def wrapped(difference: int, period: int) -> int:
    """A difference of two values of a counter that starts again after `period`: the one nearest to zero."""
    return (difference + period // 2) % period - period // 2
