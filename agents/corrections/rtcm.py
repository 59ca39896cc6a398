"""RTCM3 frames: 0xD3, six zero bits, ten of length, message, CRC-24Q (RTCM 10403, section 4). Pure."""

from functools import reduce

from agents.drivers.formats.framing import Framer, Framing

RTCM, PREAMBLE = "rtcm3", 0xD3
AROUND = 3  # bytes of preamble and length, or CRC
POLYNOMIAL = 0x1864CFB
MOST_BYTES = 1023 + 2 * AROUND


def _entry(byte: int) -> int:
    return reduce(lambda crc, _: crc << 1 ^ (POLYNOMIAL if crc & 1 << 23 else 0), range(8), byte << 16)


_TABLE = [_entry(byte) for byte in range(256)]


def crc24q(data: bytes | bytearray) -> int:
    """CRC-24Q; 0 for a whole frame with its CRC."""
    crc = 0
    for byte in data:
        crc = (crc & 0xFFFF) << 8 ^ _TABLE[crc >> 16 ^ byte]
    return crc


def _end(buffer: bytes | bytearray, start: int) -> int | None:
    """End of a frame beginning at `start`, by its length; None for no frame."""
    if buffer[start + 1 : start + 2] > b"\x03":
        return None
    if len(buffer) < start + AROUND:
        return start + 2 * AROUND
    return start + int.from_bytes(buffer[start + 1 : start + AROUND], "big") + 2 * AROUND


RTCM_FRAMING = Framing(bytes([PREAMBLE]), MOST_BYTES, _end, lambda frame: not crc24q(frame))


def rtcm_framer() -> Framer:
    """A framer; all bytes between frames count as broken."""
    return Framer({RTCM: RTCM_FRAMING}, between=b"")


def message_number(frame: bytes) -> int:
    """Number of a frame's message: 1005 is a base's position, 1074 to 1137 observations."""
    return int.from_bytes(frame[AROUND : AROUND + 2], "big") >> 4


def whole_frames(data: bytes) -> list[bytes]:
    """Adjacent frames; ValueError at the first byte that begins none."""
    frames, at = list[bytes](), 0
    while at < len(data):
        end = _end(data, at) if data[at] == PREAMBLE else None
        if end is None or end > len(data) or crc24q(data[at:end]):
            raise ValueError(f"no whole frame of RTCM3 at byte {at} of {len(data)}")
        frames.append(data[at:end])
        at = end
    return frames
