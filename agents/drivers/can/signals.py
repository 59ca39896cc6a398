"""How a signal is read from a CAN frame, and put into one, and which frames belong together. Pure.

What a sender marks as an error or as not available has no value.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

EXTENDED = 1 << 31  # added to the PGN of a 29-bit identifier, so that it never equals an 11-bit identifier
NMEA_2000 = 0x1F000  # its parameter groups begin here


@dataclass(frozen=True)
class Signal:
    """One signal: value = scale * raw + offset.

    group: key of its frames, as `group_of` makes it. start: its lowest bit, counted from that of the first byte (Intel
    order). spn: its number in J1939, 0 without one.
    """

    name: str
    group: int
    start: int
    bits: int
    scale: float = 1.0
    offset: float = 0.0
    is_signed: bool = False
    spn: int = 0

    def value(self, data: bytes) -> float | None:
        """The value in a frame; None where it has none, or the frame is too short."""
        if self.start + self.bits > 8 * len(data):
            return None
        raw = int.from_bytes(data, "little") >> self.start & (1 << self.bits) - 1
        if self.is_signed and raw >> self.bits - 1:
            raw -= 1 << self.bits
        return self.scaled(raw)

    def scaled(self, raw: float) -> float | None:
        """The value of a raw one; None where that means an error, or not available."""
        return None if raw > self._highest else self.scale * raw + self.offset

    def raw(self, value: float) -> int:
        """The raw value that is nearest to a value, of those that are one."""
        lowest = -(1 << self.bits - 1) if self.is_signed else 0
        return min(max(round((value - self.offset) / self.scale), lowest), self._highest)

    @cached_property
    def _highest(self) -> int:
        """The highest raw value that is a value: J1939 keeps first bytes from 0xFB on, NMEA 2000 the last three."""
        most = (1 << self.bits - self.is_signed) - 1
        if self.group < EXTENDED:
            return most
        if self.bits < 8:
            return most - min(most - 1, 2)
        is_nmea = self.group - EXTENDED >= NMEA_2000
        return most - 3 if is_nmea or self.is_signed else (0xFB << self.bits - 8) - 1


def frame_of(values: Iterable[tuple[Signal, float]], size: int = 8) -> bytes:
    """The frame of so many bytes with these values; all other bits are ones, which mean not available."""
    bits = (1 << 8 * size) - 1
    for signal, value in values:
        mask = (1 << signal.bits) - 1
        bits = bits & ~(mask << signal.start) | (signal.raw(value) & mask) << signal.start
    return bits.to_bytes(size, "little")


def group_of(identifier: int, *, is_extended: bool) -> int:
    """What frames of one meaning share: the PGN of a 29-bit identifier, else the 11-bit identifier itself.

    A PGN has no destination: that is its last byte where the byte before it (PF) is below 240.
    """
    if not is_extended:
        return identifier
    pgn = identifier >> 8 & 0x3FFFF
    return EXTENDED | (pgn if pgn & 0xFF00 >= 0xF000 else pgn & 0x3FF00)
