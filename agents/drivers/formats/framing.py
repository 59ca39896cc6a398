"""Bytes to frames: resynchronises after broken bytes, and loses no whole frame.

Each possible start is a candidate until its end arrives, judged by its own checksum. So neither a corrupt length nor an
accidental checksum hides a whole frame, which is out with its last byte.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

UBX, NMEA, GPSD = "ubx", "nmea", "gpsd"


class Frame(NamedTuple):
    """A whole frame. after: bytes of the same piece behind it."""

    format: str
    data: bytes
    after: int


@dataclass(frozen=True)
class Framing:
    """How a format marks frames.

    sync: begin of a frame. most: longest frame [bytes]. end: end of a frame beginning at an index, beyond the buffer
    while unknown, None for no frame. is_whole: checksum test.
    """

    sync: bytes
    most: int
    end: Callable[[bytes | bytearray, int], int | None]
    is_whole: Callable[[bytes], bool]


class Framer:
    """Cuts bytes into frames of formats with distinct first bytes.

    between: bytes allowed between frames. broken: count of others in no frame.
    """

    def __init__(self, framings: Mapping[str, Framing], between: bytes = b"\r\n") -> None:
        self.broken = 0
        self._by_first = {framing.sync[0]: (name, framing) for name, framing in framings.items()}
        syncs = [framing.sync for framing in framings.values()]
        self._sync = re.compile(b"|".join(map(re.escape, syncs)))
        cut = b"|".join(re.escape(sync[:n]) for sync in syncs for n in range(1, len(sync)))
        self._cut_sync, self._longest = re.compile(b"(?:" + cut + rb")\Z"), max(map(len, syncs))
        self._between = between
        self._buffer = bytearray()
        self._open: list[int] = []  # candidates without their end
        self._read: list[tuple[int, int]] = []  # whole frames still needed by a candidate
        self._searched = 0  # end of the search for candidates

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by these bytes, by their ends."""
        buffer, frames = self._buffer, list[Frame]()
        buffer += data
        candidates = [*self._open, *(match.start() for match in self._sync.finditer(buffer, self._searched))]
        self._open = []
        for start in candidates:
            name, framing = self._by_first[buffer[start]]
            end = framing.end(buffer, start)
            if end is None or end - start > framing.most:
                continue
            if end > len(buffer):
                self._open.append(start)
            elif framing.is_whole(frame := bytes(buffer[start:end])):
                frames.append(Frame(name, frame, len(buffer) - end))
                self._read.append((start, end))
        self._forget()
        if len(frames) > 1:
            frames.sort(key=lambda frame: -frame.after)
        return frames

    def _forget(self) -> None:
        """Drop bytes that no candidate or cut sync needs; count broken ones."""
        buffer = self._buffer
        cut = self._cut_sync.search(buffer, max(0, len(buffer) - self._longest))
        searched = cut.start() if cut else len(buffer)
        first = min([searched, *self._open])
        counted = 0
        for start, end in sorted(self._read):
            if counted < min(start, first):
                self._count_broken(counted, min(start, first))
            counted = max(counted, min(end, first))
        if counted < first:
            self._count_broken(counted, first)
        del buffer[:first]
        self._open = [start - first for start in self._open]
        self._read = [(max(start - first, 0), end - first) for start, end in self._read if end > first]
        self._searched = searched - first

    def _count_broken(self, begin: int, end: int) -> None:
        self.broken += len(self._buffer[begin:end].strip(self._between))


def _ubx_end(buffer: bytes | bytearray, start: int) -> int | None:
    """Sync (2), class, identity, length (2), payload, checksum (2)."""
    if len(buffer) < start + 6:
        return start + 8
    return start + 8 + int.from_bytes(buffer[start + 4 : start + 6], "little")


def _ubx_is_whole(frame: bytes) -> bool:
    counted = frame[2:-2]
    return sum(counted) & 255 == frame[-2] and sum(accumulate(counted)) & 255 == frame[-1]


_NMEA_END = re.compile(rb"[^ -#%-)+-~]")  # the star before the checksum, or a character foreign to sentences


def _nmea_end(buffer: bytes | bytearray, start: int) -> int | None:
    match = _NMEA_END.search(buffer, start + 1)
    if match is None:
        return len(buffer) + 1
    return match.start() + 3 if match[0] == b"*" else None


def _nmea_is_whole(frame: bytes) -> bool:
    checksum = 0
    for byte in frame[1:-3]:
        checksum ^= byte
    return frame[-2:].upper() == b"%02X" % checksum


def _gpsd_end(buffer: bytes | bytearray, start: int) -> int | None:
    end = buffer.find(b"\n", start)
    return end + 1 if end >= 0 else len(buffer) + 1


def _gpsd_is_whole(frame: bytes) -> bool:
    try:
        return isinstance(json.loads(frame), dict)
    except (ValueError, RecursionError):
        return False


FRAMINGS = {
    UBX: Framing(b"\xb5b", 4096, _ubx_end, _ubx_is_whole),  # RXM-RAWX of 100 signals has 3.2 kB
    NMEA: Framing(b"$", 255, _nmea_end, _nmea_is_whole),  # 82 by the standard; precise receivers send more
    GPSD: Framing(b'{"class":', 10_240, _gpsd_end, _gpsd_is_whole),  # gpsd's own limit
}
