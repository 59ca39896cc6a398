"""NMEA 0183 sentences to messages. Pure.

Sentences have a time without date, or none. RMC and ZDA give the date; midnight may lie between. Untimed sentences
belong to the surrounding epoch.
"""

import math
from collections.abc import Collection, Sequence
from datetime import UTC, datetime

from agents.drivers import formats
from agents.drivers.formats import Message
from protocol.units import DAY_NS, ddmm_deg, factor

SENTENCES = frozenset(("RMC", "ZDA", "GGA", "GST", "VTG", "HDT", "THS"))  # a method of the receiver each
# GGA's quality: name, and range error [m], which HDOP scales to position without GST.
QUALITIES = {1: ("autonomous", 3.0), 2: ("differential", 1.5), 4: ("fixed", 0.02), 5: ("float", 0.3)}
KNOT_MPS = factor("kn", "speed_mps")
SPEED_STD_MPS = 0.1  # of Doppler velocity; NMEA states none
HEADING_STD_RAD = math.radians(0.5)  # of two antennas a metre apart; NMEA states none
SAME_EPOCH = 0.75  # share of the epoch interval within which an untimed sentence belongs to the last epoch


class NmeaDecoder:
    """Decodes one line's sentences. talkers: receivers of their own; all others count as one."""

    def __init__(self, talkers: Collection[str] = ()) -> None:
        self._receivers = {talker: _Receiver(talker) for talker in ("", *talkers)}

    def decode(self, frame: bytes, host_ns: int) -> Sequence[Message]:
        """Messages of a checked sentence; none of unused kinds."""
        address, *words = frame[1:-3].decode("ascii").split(",")
        if len(address) != 5 or (sentence := address[2:]) not in SENTENCES:
            return ()
        receiver = self._receivers.get(address[:2].lower(), self._receivers[""])
        taken: Sequence[Message] = getattr(receiver, sentence.lower())(words, host_ns)
        return taken


class _Receiver:
    """State between one receiver's sentences."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._utc_ns = 0  # of the newest epoch, 0 without date
        self._arrived_ns = 0  # of its first sentence
        self._period_ns = 10**9  # between epochs
        self._quality = 0
        self._std_m: tuple[float, float, float] | None = None  # by the last GST
        self._states_velocity = False  # by RMC, which has its time

    def rmc(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """Time, date, speed, course."""
        time, status, _, _, _, _, speed, course, date = _first(words, 9)
        if status != "A" or not (time and date):
            return ()
        begun = self._begin_epoch(_utc_ns(time, date[4:], date[2:4], date[:2]), host_ns)
        self._states_velocity = True
        return *begun, *self._velocity(self._utc_ns, speed, course)

    def zda(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """Time and date, once there is a fix: before, receivers may guess."""
        time, day, month, year = _first(words, 4)
        if self._quality and time and day and month and year:
            return self._begin_epoch(_utc_ns(time, year, month, day), host_ns)
        return ()

    def gga(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """Position and quality."""
        time, lat, north, lon, east, quality, satellites, hdop, height, _, separation = _first(words, 11)
        before, self._quality = self._quality, int(quality or 0)
        count = int(satellites or 0)
        if self._quality not in QUALITIES or not time:
            self._quality = 0
            return (Message(formats.FIX, self._source, 0, satellites=count),)
        if before != self._quality:
            self._std_m = None  # of another kind of fix
        begun = self._begin_epoch(self._dated_ns(_time_of_day_ns(time)), host_ns)
        name, range_m = QUALITIES[self._quality]
        horizontal_m = range_m * float(hdop or math.nan)
        std_m = self._std_m or (horizontal_m, horizontal_m, 2 * horizontal_m)
        height_m = float(height or 0) + float(separation or 0)
        values = (ddmm_deg(lat, north or "-"), ddmm_deg(lon, east or "-"), height_m, *map(formats.variance, std_m))
        return *begun, Message(formats.FIX, self._source, self._utc_ns, values, quality=name, satellites=count)

    def gst(self, words: list[str], _: int) -> Sequence[Message]:
        """Standard deviations of fixes; 0 means unknown."""
        north_m, east_m, up_m = (float(word or 0) for word in _first(words, 8)[5:])
        self._std_m = (east_m, north_m, up_m) if min(north_m, east_m, up_m) > 0 else None
        return ()

    def vtg(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """Speed and course, without RMC."""
        course, _, _, _, knots, _, _, _ = _first(words, 8)
        is_valid = self._quality and (len(words) < 9 or words[8] != "N")
        return (
            self._velocity(self._untimed_ns(host_ns), knots, course) if is_valid and not self._states_velocity else ()
        )

    def hdt(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """Heading of two antennas."""
        return self.ths([*words[:1], "A"], host_ns)

    def ths(self, words: list[str], host_ns: int) -> Sequence[Message]:
        """The same with a mode; only autonomous counts."""
        degrees, mode = _first(words, 2)
        if mode != "A" or not degrees:
            return ()
        values = formats.heading(math.radians(float(degrees)), HEADING_STD_RAD)
        return (Message(formats.HEADING, self._source, self._untimed_ns(host_ns), values),)

    def _velocity(self, utc_ns: int, knots: str, course: str) -> Sequence[Message]:
        """Slow receivers state no course: then the speed is an error around zero."""
        if not knots:
            return ()
        speed_mps = float(knots) * KNOT_MPS
        values = formats.velocity(speed_mps, math.radians(float(course or 0)), SPEED_STD_MPS)
        if not course:
            values = formats.velocity(0.0, 0.0, max(SPEED_STD_MPS, speed_mps))
        return (Message(formats.VELOCITY, self._source, utc_ns, values),)

    def _dated_ns(self, time_ns: int) -> int:
        """Time of day with the date nearest to the last epoch; 0 without date."""
        return self._utc_ns and self._utc_ns + formats.wrapped(time_ns - self._utc_ns % DAY_NS, DAY_NS)

    def _begin_epoch(self, utc_ns: int, host_ns: int) -> Sequence[Message]:
        """Note a sentence's time; a time message for the first of an epoch."""
        if utc_ns == self._utc_ns:
            return ()
        if 0 < utc_ns - self._utc_ns <= 2 * 10**9:
            self._period_ns = utc_ns - self._utc_ns
        self._utc_ns, self._arrived_ns = utc_ns, host_ns
        return (Message(formats.TIME, self._source, utc_ns),)

    def _untimed_ns(self, host_ns: int) -> int:
        """Epoch of an untimed sentence: the last, or the next if almost due."""
        is_next = host_ns - self._arrived_ns > SAME_EPOCH * self._period_ns
        return self._utc_ns and self._utc_ns + (self._period_ns if is_next else 0)


def _first(words: list[str], n: int) -> list[str]:
    if len(words) < n:
        raise ValueError(f"{len(words)} fields, {n} are expected")
    return words[:n]


def _time_of_day_ns(text: str) -> int:
    """Nanoseconds since midnight of hhmmss.sss; a leap second (60) counts as the next minute."""
    hours, minutes, seconds = int(text[:2]), int(text[2:4]), float(text[4:])
    if not (0 <= hours < 24 and 0 <= minutes < 60 and 0 <= seconds < 61):
        raise ValueError(f"{text!r} is no time")
    return (hours * 60 + minutes) * 60 * 10**9 + round(seconds * 1e9)


def _utc_ns(time: str, year: str, month: str, day: str) -> int:
    """UTC of time and date; two-digit years mean 1980 to 2079."""
    full = int(year) if len(year) > 2 else (int(year) - 80) % 100 + 1980
    midnight = datetime(full, int(month), int(day), tzinfo=UTC)
    return formats.rolled_over(round(midnight.timestamp()) * 10**9 + _time_of_day_ns(time))
