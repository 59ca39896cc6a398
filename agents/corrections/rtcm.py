"""RTCM3 frames out of bytes: 0xD3, six zero bits, ten of length, a message, CRC-24Q (RTCM 10403, section 4). Pure.

What seems to begin a frame is a candidate until its end has come, and what begins inside of it is one too. So a spoiled
length hides no whole frame, and holds none up.
"""

import re
from functools import reduce

AROUND = 3  # bytes of preamble and length before a message, and of the CRC behind it
POLYNOMIAL = 0x1864CFB
_BEGIN = re.compile(rb"\xd3[\x00-\x03]")


def _entry(byte: int) -> int:
    return reduce(lambda crc, _: crc << 1 ^ (POLYNOMIAL if crc & 1 << 23 else 0), range(8), byte << 16)


_TABLE = [_entry(byte) for byte in range(256)]


def crc24q(data: bytes | bytearray) -> int:
    """CRC-24Q; 0 of a whole frame with its CRC."""
    crc = 0
    for byte in data:
        crc = (crc & 0xFFFF) << 8 ^ _TABLE[crc >> 16 ^ byte]
    return crc


class RtcmFramer:
    """Cuts a stream of bytes into frames. broken: how many bytes belong to none. It keeps less than two frames."""

    def __init__(self) -> None:
        self.broken = 0
        self._buffer = bytearray()
        self._open: list[int] = []  # candidates whose end has not come
        self._searched = 0  # up to where candidates are known

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that these bytes make whole."""
        buffer, done = self._buffer, 0
        buffer += data
        candidates = [*self._open, *(match.start() for match in _BEGIN.finditer(buffer, self._searched))]
        frames, self._open = list[bytes](), []
        for start in candidates:
            if start < done:
                continue
            end = _end(buffer, start)
            if len(buffer) < max(end, start + AROUND):
                self._open.append(start)
            elif not crc24q(buffer[start:end]):
                frames.append(bytes(buffer[start:end]))
                self.broken += start - done
                self._open, done = [], end
        self._forget(done)
        return frames

    def _forget(self, done: int) -> None:
        """Drop the bytes that no candidate needs."""
        searched = len(self._buffer) - self._buffer.endswith(b"\xd3")
        first = min([max(searched, done), *self._open])
        self.broken += first - done
        del self._buffer[:first]
        self._open = [start - first for start in self._open]
        self._searched = max(searched - first, 0)


def whole_frames(data: bytes) -> list[bytes]:
    """Frames that lie end to end; ValueError at the first byte that begins none, so that nothing is looked at twice."""
    frames, at = list[bytes](), 0
    while at < len(data):
        end = _end(data, at)
        if not _BEGIN.match(data, at) or end > len(data) or crc24q(data[at:end]):
            raise ValueError(f"no whole frame of RTCM3 at byte {at} of {len(data)}")
        frames.append(data[at:end])
        at = end
    return frames


def _end(data: bytes | bytearray, start: int) -> int:
    """Where a frame that begins at `start` ends, by its length."""
    return start + int.from_bytes(data[start + 1 : start + AROUND], "big") + 2 * AROUND
