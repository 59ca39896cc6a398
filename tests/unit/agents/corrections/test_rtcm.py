"""RTCM3 framing: every whole frame from any stream, as pyrtcm does it."""

from __future__ import annotations

import io
import random

import pytest
from pyrtcm import RTCMReader, calc_crc24q

from agents.corrections.rtcm import crc24q, rtcm_framer, whole_frames
from agents.drivers.formats.framing import Framer
from tests.paths import SHARED_DATA

RECORDING = SHARED_DATA / "recordings" / "rtcm3_ntrip.rtcm"


def frame(rng: random.Random, size: int | None = None) -> bytes:
    message = rng.randbytes(rng.choice((0, 1, 19, 300, 1023)) if size is None else size)
    head = b"\xd3" + len(message).to_bytes(2, "big") + message
    return head + calc_crc24q(head).to_bytes(3, "big")


def garbage(rng: random.Random) -> bytes:
    """Noise, false heads, text, cut frames, frames with a bit flipped."""
    spoiled = bytearray(frame(rng))
    spoiled[rng.randrange(len(spoiled))] ^= 1 << rng.randrange(8)
    cut = frame(rng)[: rng.randrange(6)]
    return rng.choice(
        (b"", rng.randbytes(50), b"\xd3" * 9, b"\xd3\x03\xff" * 5, b"ICY 200 OK\r\n", bytes(spoiled), cut)
    )


def fed(data: bytes, rng: random.Random, most: int = 700) -> tuple[list[bytes], Framer]:
    framer, frames, at = rtcm_framer(), list[bytes](), 0
    while at < len(data):
        size = rng.randint(1, most)
        frames += [frame.data for frame in framer.feed(data[at : at + size])]
        assert len(framer._buffer) < 2 * 1029 + size
        at += size
    return frames, framer


@pytest.mark.parametrize("seed", range(5))
def test_every_whole_frame_among_broken_ones_is_found_and_nothing_else(seed: int) -> None:
    rng = random.Random(seed)
    sent, stream, broken = [], bytearray(), 0
    for _ in range(120):
        junk, whole = garbage(rng), frame(rng)
        sent.append(whole)
        stream += junk + whole
        broken += len(junk)
    frames, framer = fed(bytes(stream) + bytes(1029), rng)
    assert frames == sent
    assert framer.broken == broken + 1029


def test_a_whole_frame_is_out_with_its_last_byte_whatever_seems_to_have_begun() -> None:
    rng, framer = random.Random(1), rtcm_framer()
    whole = frame(rng, 100)
    assert framer.feed(b"\xd3\x03\xff" + whole[:-1]) == []
    assert [frame.data for frame in framer.feed(whole[-1:])] == [whole]


def test_noise_without_end_is_dropped_and_counted() -> None:
    rng = random.Random(2)
    data = b"\xd3\x03" * 3000 + rng.randbytes(20_000)
    frames, framer = fed(data, rng, most=4096)
    assert not frames
    assert framer.broken >= len(data) - 1029


def test_frames_that_lie_end_to_end_are_told_from_anything_else() -> None:
    rng = random.Random(3)
    several = [frame(rng) for _ in range(5)]
    assert whole_frames(b"".join(several)) == several
    assert whole_frames(b"") == []
    for wrong in (several[3] + b"\x00", several[3][:-1], b"\x00" + several[3], several[3][:-1] + b"\x00"):
        with pytest.raises(ValueError, match="no whole frame"):
            whole_frames(wrong)


def test_the_checksum_is_the_oracles() -> None:
    rng = random.Random(4)
    for size in (0, 1, 2, 500):
        data = rng.randbytes(size)
        assert crc24q(data) == calc_crc24q(data)


@pytest.mark.skipif(not RECORDING.is_file(), reason=f"the recording is not beside the project ({RECORDING.name})")
def test_a_recording_of_a_caster_has_the_frames_that_the_oracle_finds() -> None:
    data = RECORDING.read_bytes()
    expected = [raw for raw, _ in RTCMReader(io.BytesIO(data), quitonerror=0) if raw]
    assert expected
    assert fed(data, random.Random(5))[0] == expected
