"""Bytes into frames: finds its way again after broken bytes, and loses no whole frame among broken ones.

A frame that seems to begin is a candidate until its end has come: what begins inside of it is a candidate too. So a
spoiled length hides nothing, and a whole frame is out as soon as its last byte is in.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

UBX, NMEA, GPSD = "ubx", "nmea", "gpsd"


class Frame(NamedTuple):
    """A whole frame. format: by name. after: how many bytes of the same piece came after its end."""

    format: str
    data: bytes
    after: int


@dataclass(frozen=True)
class Framing:
    """How a format tells frames from other bytes.

    sync: how a frame begins. most: bytes of the longest frame. end: where a frame that begins at an index ends, beyond
    the buffer while that is not known, None where no frame is there. is_whole: whether its checksum is right.
    """

    sync: bytes
    most: int
    end: Callable[[bytearray, int], int | None]
    is_whole: Callable[[bytes], bool]


class Framer:
    """Cuts a stream of bytes into frames of all formats. broken: how many bytes belong to none."""

    def __init__(self) -> None:
        self.broken = 0
        self._buffer = bytearray()
        self._open: list[int] = []  # candidates whose end has not come
        self._searched = 0  # up to where candidates are known

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes make whole."""
        buffer, done = self._buffer, 0
        buffer += data
        candidates = [*self._open, *(match.start() for match in _SYNC.finditer(buffer, self._searched))]
        frames, self._open = list[Frame](), []
        for start in candidates:
            if start < done:
                continue
            name = _BY_FIRST[buffer[start]]
            framing = FRAMINGS[name]
            end = framing.end(buffer, start)
            if end is None or end - start > framing.most:
                continue
            if end > len(buffer):
                self._open.append(start)
            elif framing.is_whole(frame := bytes(buffer[start:end])):
                frames.append(Frame(name, frame, len(buffer) - end))
                self._count_broken(done, start)
                self._open, done = [], end
        self._forget(done)
        return frames

    def _forget(self, done: int) -> None:
        """Drop the bytes that no candidate needs, nor a sync that is cut."""
        cut = _CUT_SYNC.search(self._buffer, max(done, len(self._buffer) - LONGEST_SYNC))
        searched = cut.start() if cut else len(self._buffer)
        first = min([searched, *self._open])
        self._count_broken(done, first)
        del self._buffer[:first]
        self._open = [start - first for start in self._open]
        self._searched = searched - first

    def _count_broken(self, begin: int, end: int) -> None:
        self.broken += len(self._buffer[begin:end].strip(b"\r\n"))


def _ubx_end(buffer: bytearray, start: int) -> int | None:
    """Two bytes of sync, class, identity, length, payload, two of checksum."""
    if len(buffer) < start + 6:
        return start + 8
    return start + 8 + int.from_bytes(buffer[start + 4 : start + 6], "little")


def _ubx_is_whole(frame: bytes) -> bool:
    """Fletcher's checksum."""
    counted = frame[2:-2]
    return sum(counted) & 255 == frame[-2] and sum(accumulate(counted)) & 255 == frame[-1]


_NMEA_END = re.compile(rb"[^ -#%-)+-~]")  # the star before the checksum, or what no sentence holds


def _nmea_end(buffer: bytearray, start: int) -> int | None:
    match = _NMEA_END.search(buffer, start + 1)
    if match is None:
        return len(buffer) + 1
    return match.start() + 3 if match[0] == b"*" else None


def _nmea_is_whole(frame: bytes) -> bool:
    """All between dollar and star, by exclusive or."""
    checksum = 0
    for byte in frame[1:-3]:
        checksum ^= byte
    return frame[-2:].upper() == b"%02X" % checksum


def _gpsd_end(buffer: bytearray, start: int) -> int | None:
    end = buffer.find(b"\n", start)
    return end + 1 if end >= 0 else len(buffer) + 1


def _gpsd_is_whole(frame: bytes) -> bool:
    try:
        return isinstance(json.loads(frame), dict)
    except (ValueError, RecursionError):
        return False


FRAMINGS = {
    UBX: Framing(b"\xb5b", 4096, _ubx_end, _ubx_is_whole),  # RXM-RAWX of 100 signals has 3.2 kB
    NMEA: Framing(b"$", 255, _nmea_end, _nmea_is_whole),  # 82 by the standard, more where receivers are precise
    GPSD: Framing(b'{"class":', 10_240, _gpsd_end, _gpsd_is_whole),  # gpsd's own limit
}
_BY_FIRST = {framing.sync[0]: name for name, framing in FRAMINGS.items()}
_SYNC = re.compile(b"|".join(re.escape(framing.sync) for framing in FRAMINGS.values()))
_CUT = [re.escape(framing.sync[:n]) for framing in FRAMINGS.values() for n in range(1, len(framing.sync))]
_CUT_SYNC = re.compile(b"(?:" + b"|".join(_CUT) + rb")\Z")
LONGEST_SYNC = max(len(framing.sync) for framing in FRAMINGS.values())
