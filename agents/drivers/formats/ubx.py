"""UBX frames of u-blox to messages. Pure. Offsets, scales and flags: interface descriptions M8 to F9.

NAV-PVT: fix, accuracies, Doppler velocity. NAV-RELPOSNED: heading of two antennas. ESF-MEAS, ESF-RAW: internal IMU and
wheel ticks, by sensor clocks.
"""

import math
import struct
from collections.abc import Collection, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from struct import Struct

from agents.drivers import formats
from agents.drivers.formats import Message

PVT = Struct("<IH6BIi2BxB4i2I2i12xI6xH")
RELPOSNED = Struct("<B3xI16xi24xI4xI")
MEAS, RAW = Struct("<IHH"), Struct("<II")
BY_SATELLITES = (2, 3, 4)  # fix types with a position: 2-D, 3-D, and with the receiver's sensors
CARRIER = ("autonomous", "float", "fixed")  # quality by carrier solution
HEADING_VALID = 1 | 1 << 2 | 1 << 8  # fix, relative position, heading
GYROS, FORCES = (14, 13, 5), (16, 17, 18)  # data types of x, y, z
RAD_PER_LSB, MPS2_PER_LSB = math.radians(2**-12), 2**-10
AXLES = ((8, 9), (6, 7), (10, 10))  # left and right wheel of rear axle, front axle; one sensor for all
BACKWARD, TICK_RANGE = 1 << 23, 1 << 23  # reverse flag, and counter period
SIGN = 1 << 23  # of a 24-bit value
TOGETHER_NS = 20 * 10**6  # of rates and forces in one reading: their frames come 5 ms apart


class UbxDecoder:
    """Decodes one receiver's frames."""

    def __init__(self, _: Collection[str] = ()) -> None:
        self._epoch: tuple[int, int] | None = None  # time of week [ms] of the newest NAV-PVT, and UTC [ns]
        self._measured_clock = _TagClock(10**6, 1 << 32)
        self._raw_clock = _TagClock(39_062.5, 1 << 24)  # of the BMI160 in M8 and F9 receivers
        self._has_raw = False
        self._takes = {(1, 7): self.pvt, (1, 60): self.relposned, (16, 2): self.measured, (16, 3): self.raw}
        self._axes: dict[int, tuple[int, float]] = {}  # tag and value, by data type
        self._wheels: dict[int, tuple[int, int]] = {}  # counter, and ticks since the start, by data type

    def decode(self, frame: bytes, _: int) -> Sequence[Message]:
        """Messages of a checked frame; none of unused kinds."""
        take = self._takes.get((frame[2], frame[3]))
        try:
            return take(frame[6:-2]) if take else ()
        except struct.error as error:
            raise ValueError(str(error)) from None

    def pvt(self, payload: bytes) -> Sequence[Message]:
        """Position, velocity, time."""
        fields = PVT.unpack_from(payload)
        week_ms, *date, valid, _, nano, fix_type, flags, satellites = fields[:13]
        lon, lat, height_mm, _, horizontal_mm, vertical_mm, north_mmps, east_mmps, speed_std_mmps, flags3 = fields[13:]
        utc_ns = _utc_ns(date, nano) if valid & 7 == 7 else 0  # date, time, leap seconds
        if utc_ns:
            self._epoch = week_ms, utc_ns
        time = (Message(formats.TIME, "", utc_ns),) if utc_ns else ()
        if fix_type not in BY_SATELLITES or not flags & 1 or flags3 & 1:
            return *time, Message(formats.FIX, "", 0, satellites=satellites)
        quality = CARRIER[min(flags >> 6, 2)] if flags >> 6 or not flags & 2 else "differential"
        variances = (formats.variance(std_mm * 1e-3) for std_mm in (horizontal_mm, horizontal_mm, vertical_mm))
        fix = (lat * 1e-7, lon * 1e-7, height_mm * 1e-3, *variances)
        moving = (east_mmps * 1e-3, north_mmps * 1e-3, *(formats.variance(speed_std_mmps * 1e-3),) * 2)
        return (
            *time,
            Message(formats.FIX, "", utc_ns, fix, quality=quality, satellites=satellites),
            Message(formats.VELOCITY, "", utc_ns, moving),
        )

    def relposned(self, payload: bytes) -> Sequence[Message]:
        """Direction from the base's antenna to the rover's."""
        version, week_ms, direction, accuracy, flags = RELPOSNED.unpack_from(payload)
        if version != 1 or flags & HEADING_VALID != HEADING_VALID:
            return ()
        epoch_ms, epoch_ns = self._epoch or (week_ms, 0)
        utc_ns = epoch_ns and epoch_ns + formats.wrapped((week_ms - epoch_ms) * 10**6, formats.WEEK_NS)
        values = formats.heading(math.radians(direction * 1e-5), math.radians(accuracy * 1e-5))
        return (Message(formats.HEADING, "", utc_ns, values),)

    def measured(self, payload: bytes) -> Sequence[Message]:
        """ESF-MEAS: one time for all words; a last word may repeat it."""
        tag, flags, _ = MEAS.unpack_from(payload)
        count = flags >> 11 or (len(payload) - MEAS.size) // 4 - (flags >> 3 & 1)
        words = struct.unpack_from(f"<{count}I", payload, MEAS.size)
        tag_ns = self._measured_clock.ns(tag)
        inertial = () if self._has_raw else self._inertial((word, tag_ns) for word in words)
        return [*inertial, *self._ticks(words, tag_ns)]

    def raw(self, payload: bytes) -> Sequence[Message]:
        """ESF-RAW: a time per word; the same IMU at a higher rate."""
        self._has_raw = True
        tagged = RAW.iter_unpack(payload[4:])
        return list(self._inertial((word, self._raw_clock.ns(tag)) for word, tag in tagged))

    def _inertial(self, tagged: Iterable[tuple[int, int]]) -> Iterator[Message]:
        """Readings of all six axes, at their mean time."""
        axes = self._axes
        for word, tag_ns in tagged:
            axis = word >> 24 & 63
            if axis not in _SCALES:
                continue
            axes[axis] = tag_ns, ((word & 0xFFFFFF ^ SIGN) - SIGN) * _SCALES[axis]
            if len(axes) < len(_SCALES):
                continue
            first_ns, last_ns = min(axes.values())[0], max(axes.values())[0]
            if last_ns - first_ns <= TOGETHER_NS:
                values = tuple([axes[a][1] for a in _SCALES])
                yield Message(formats.IMU, "", 0, values, (first_ns + last_ns) // 2)
                axes.clear()

    def _ticks(self, words: Sequence[int], tag_ns: int) -> Sequence[Message]:
        present = {kind: word for word in words if 6 <= (kind := word >> 24 & 63) <= 10}
        if not present:
            return ()
        for left, right in AXLES:
            if left in present and right in present:
                ticks = [self._counted(wheel, present[wheel]) for wheel in dict.fromkeys((left, right))]
                return (Message(formats.WHEELS, "", 0, (float(ticks[0]), float(ticks[-1])), tag_ns),)
        return ()

    def _counted(self, wheel: int, word: int) -> int:
        """Ticks since the start; the counter wraps, and counts up in reverse too."""
        counter = word & (TICK_RANGE - 1)
        before, total = self._wheels.get(wheel, (counter, 0))
        driven = formats.wrapped(counter - before, TICK_RANGE)
        total += -driven if word & BACKWARD else driven
        self._wheels[wheel] = counter, total
        return total


_SCALES = dict.fromkeys(GYROS, RAD_PER_LSB) | dict.fromkeys(FORCES, MPS2_PER_LSB)


class _TagClock:
    """Time by a wrapping tick counter; unit_ns per tick."""

    def __init__(self, unit_ns: float, period: int) -> None:
        self._unit_ns, self._period = unit_ns, period
        self._ticks = period  # keeps slightly older ticks positive

    def ns(self, counter: int) -> int:
        """Nanoseconds from an unknown start."""
        self._ticks += formats.wrapped(counter - self._ticks, self._period)
        return round(self._ticks * self._unit_ns)


def _utc_ns(date: Sequence[int], nano: int) -> int:
    """UTC of year to second and signed nanoseconds; second 60 is a leap second."""
    *whole, second = date
    if second > 60 or abs(nano) > 10**9:
        raise ValueError(f"{second} s, {nano} ns are no time")
    minute = datetime(*whole, tzinfo=UTC)  # type: ignore[arg-type, misc]
    return formats.rolled_over((round(minute.timestamp()) + second) * 10**9 + nano)
