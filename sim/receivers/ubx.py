"""u-blox UBX, frames by the interface descriptions M8 to F9 in their integer units.

Reader, and scales of ESF-MEAS: `agents/drivers/formats/ubx.py`.
"""

import math
from collections.abc import Sequence
from itertools import accumulate
from struct import Struct, pack
from typing import NamedTuple

from agents.drivers.formats.ubx import BACKWARD, FORCES, GYROS, MPS2_PER_LSB, RAD_PER_LSB, TICK_RANGE
from protocol.machine.readings import Encoder, Imu
from sim.receivers.epoch import GEOID_M, SATELLITES, Epoch, quality

LEAP_S = 18  # GPS time ahead of UTC since 2017
GPS_BEGAN_S = 315_964_800  # 1980-01-06 in UTC
WEEK_S = 604_800
VALID = 7  # NAV-PVT: date and time valid, leap seconds known
FLAGS = {"autonomous": 1, "differential": 1 | 1 << 1, "float": 1 | 1 << 1 | 1 << 6, "fixed": 1 | 1 << 1 | 2 << 6}
RELATIVE = 1 | 1 << 1 | 1 << 2 | 2 << 3 | 1 << 5 | 1 << 8  # fix, differential, valid, fixed, moving base, heading valid
REAR_WHEELS = (8, 9)  # data types of ESF-MEAS, left and right
_PVT = Struct("<IH6BIi4B4i2I5i2I2H12x")
_RELPOSNED = Struct("<B3xI5i4x4b5I4xI")


class NavPvt(NamedTuple):
    """NAV-PVT up to flags3, in the order and units of its fields."""

    itow_ms: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    valid: int
    time_acc_ns: int = 20
    nano: int = 0
    fix_type: int = 0
    flags: int = 0
    flags2: int = 0
    satellites: int = 0
    lon_1e7: int = 0
    lat_1e7: int = 0
    height_mm: int = 0
    sea_height_mm: int = 0
    horizontal_acc_mm: int = 0
    vertical_acc_mm: int = 0
    north_mmps: int = 0
    east_mmps: int = 0
    down_mmps: int = 0
    speed_mmps: int = 0
    course_1e5: int = 0
    speed_acc_mmps: int = 0
    course_acc_1e5: int = 0
    pdop_1e2: int = 120
    flags3: int = 0

    def frame(self) -> bytes:
        """As sent."""
        return frame(0x01, 0x07, _PVT.pack(*self))


def frame(kind: int, identity: int, payload: bytes) -> bytes:
    """Add header and Fletcher checksum."""
    counted = pack("<BBH", kind, identity, len(payload)) + payload
    return b"\xb5b" + counted + bytes((sum(counted) & 255, sum(accumulate(counted)) & 255))


def esf_meas(tag_ms: int, data: Sequence[tuple[int, int]]) -> bytes:
    """ESF-MEAS of (data type, signed 24-bit value), with a time tag."""
    words = [kind << 24 | value & 0xFFFFFF for kind, value in data]
    tag = tag_ms % 2**32
    return frame(0x10, 0x02, pack(f"<IHH{len(words) + 1}I", tag, len(words) << 11 | 1 << 3, 0, *words, tag))


class UbxWriter:
    """Frames of one receiver; its wheel counters count up in reverse too."""

    def __init__(self) -> None:
        self._before: tuple[int, int] | None = None
        self._counters = [0, 0]

    def epoch(self, epoch: Epoch) -> bytes:
        """NAV-PVT, and NAV-RELPOSNED if there is a baseline."""
        return nav_pvt(epoch).frame() + _relposned(epoch)

    def imu(self, reading: Imu) -> bytes:
        """All six axes in one ESF-MEAS."""
        rates = (reading.gyro_x_radps, reading.gyro_y_radps, reading.gyro_z_radps)
        forces = (reading.force_x_mps2, reading.force_y_mps2, reading.force_z_mps2)
        values = [round(rate / RAD_PER_LSB) for rate in rates] + [round(force / MPS2_PER_LSB) for force in forces]
        return esf_meas(reading.stamp_ns // 10**6, list(zip(GYROS + FORCES, values, strict=True)))

    def wheels(self, reading: Encoder) -> bytes:
        """Both rear wheels."""
        ticks = math.floor(reading.left_ticks), math.floor(reading.right_ticks)
        words = []
        for i, (now, before) in enumerate(zip(ticks, self._before or ticks, strict=True)):
            self._counters[i] = (self._counters[i] + abs(now - before)) % TICK_RANGE
            words.append(self._counters[i] | BACKWARD * (now < before))
        self._before = ticks
        return esf_meas(reading.stamp_ns // 10**6, list(zip(REAR_WHEELS, words, strict=True)))


def nav_pvt(epoch: Epoch) -> NavPvt:
    """Time; place and velocity if there is a fix."""
    time, fix, motion = epoch.time, epoch.fix, epoch.motion
    date = (time.year, time.month, time.day, time.hour, time.minute, time.second, VALID)
    timed = NavPvt(_itow_ms(epoch.utc_ns), *date, nano=epoch.utc_ns % 10**9)
    if fix is None:
        return timed
    placed = timed._replace(
        fix_type=3,
        flags=FLAGS[quality(fix)],
        satellites=SATELLITES,
        lon_1e7=round(fix.lon_deg * 1e7),
        lat_1e7=round(fix.lat_deg * 1e7),
        height_mm=round(fix.height_m * 1e3),
        sea_height_mm=round((fix.height_m - GEOID_M) * 1e3),
        horizontal_acc_mm=round(fix.var_e_m2**0.5 * 1e3),
        vertical_acc_mm=round(fix.var_u_m2**0.5 * 1e3),
    )
    if motion is None:
        return placed
    east_mps, north_mps = motion.velocity_e_mps, motion.velocity_n_mps
    return placed._replace(
        north_mmps=round(north_mps * 1e3),
        east_mmps=round(east_mps * 1e3),
        speed_mmps=round(math.hypot(east_mps, north_mps) * 1e3),
        course_1e5=round(math.degrees(math.atan2(east_mps, north_mps)) % 360 * 1e5),
        speed_acc_mmps=round(motion.var_e_m2ps2**0.5 * 1e3),
    )


def _relposned(epoch: Epoch) -> bytes:
    if not (line := epoch.baseline):
        return b""
    tenths_mm = [round(metres * 1e4) for metres in (*line[:3], math.hypot(*line[:3]))]
    whole_cm, rest = zip(*((round(value / 100), value - 100 * round(value / 100)) for value in tenths_mm), strict=True)
    heading_1e5 = round(math.degrees(line.heading_rad) * 1e5)
    accuracy_1e5 = round(math.degrees(line.std_rad) * 1e5)
    length_acc = round(line.std_rad * math.hypot(*line[:2]) * 1e4)
    fields = (*whole_cm, heading_1e5, *rest, *(length_acc,) * 4, accuracy_1e5, RELATIVE)
    return frame(0x01, 0x3C, _RELPOSNED.pack(1, _itow_ms(epoch.utc_ns), *fields))


def _itow_ms(utc_ns: int) -> int:
    return (utc_ns // 10**6 + (LEAP_S - GPS_BEGAN_S) * 1000) % (WEEK_S * 1000)
