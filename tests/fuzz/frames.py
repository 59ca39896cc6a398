"""`python -m tests.fuzz.frames --cases 1000000`: broken receiver frames.

Frames are flipped, cut and overwritten, or have hostile fields with valid checksums. Nothing may raise, and every valid
frame among them is read. `--format`: one of `nmea`, `ubx`, `gpsd`; default all.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from agents.drivers.formats.framing import FRAMINGS, Framer
from agents.drivers.line import Line
from protocol.machine.machine_config import SensorConfig

FEEDS = {
    "fix": SensorConfig("gps-1", "gps", std={"position": 1.0}),
    "velocity": SensorConfig("doppler", "gps_velocity", std={"velocity": 0.1}),
    "heading": SensorConfig("compass", "attitude"),
    "imu": SensorConfig("imu-1", "imu"),
    "wheels": SensorConfig("wheels", "encoder"),
}
SENTENCES = (
    "GNRMC,101527.20,A,4900.6074040,N,00824.0340680,E,4.179,86.80,261126,,,R,V",
    "GNGGA,101527.20,4900.6074040,N,00824.0340680,E,4,17,0.60,110.2,M,47.1,M,1.0,0001",
    "GNGST,101527.20,0.8,0.021,0.014,12.0,0.020,0.015,0.03",
    "GNVTG,86.80,T,,M,4.179,N,7.740,K,R",
    "GNZDA,101527.20,26,11,2026,00,00",
    "GNHDT,86.91,T",
    "GNTHS,86.91,A",
)
WORDS = (
    "",
    "nan",
    "-inf",
    "1e999",
    "9" * 90,
    "-1",
    ".",
    "-",
    "1_0",
    "0x1",
    "E",
    "000000",
    "235960.99",
    "999999",
    "*",
    "$",
)
FRAMES = ((0x01, 0x07, 92), (0x01, 0x3C, 64), (0x10, 0x02, 24), (0x10, 0x03, 60), (0x0A, 0x04, 40))
VALUES = (None, True, "", "x", [], {}, -1, 1e308, 10**400, [[]], {"a": 1}, "2026-11-26T10:15:27.200Z", "9999-12-31", 3)
NAMES = ("mode", "time", "lat", "lon", "altHAE", "alt", "speed", "track", "status", "device", "uSat")


def nmea(draw: random.Random) -> bytes:
    """A sentence with arbitrary fields."""
    words = draw.choice(SENTENCES).split(",")
    for _ in range(draw.randrange(4)):
        words[draw.randrange(len(words))] = draw.choice(WORDS)
    text = ",".join(words[: draw.randrange(1, len(words) + 2)])
    checksum = 0
    for byte in text.encode():
        checksum ^= byte
    return f"${text}*{checksum:02X}\r\n".encode()


def ubx(draw: random.Random) -> bytes:
    """A frame with an arbitrary payload."""
    kind, identity, size = draw.choice(FRAMES)
    payload = bytearray(draw.randbytes(size + draw.choice((0, 0, 0, -1, 4, -size))))
    if size == 92 and len(payload) == 92 and draw.random() < 0.5:  # reaches code beyond the date
        payload[4:12] = (2026).to_bytes(2, "little") + bytes((11, 26, 10, 15, draw.randrange(62), 7))
        payload[16:22] = bytes(4) + bytes((3, 1))
    body = bytes((kind, identity)) + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5b" + body + bytes((a, b))


def gpsd(draw: random.Random) -> bytes:
    """A report with arbitrary values."""
    report: dict[str, object] = {"class": draw.choice(("TPV", "TPV", "SKY", 5, None, []))}
    report |= {"mode": 3, "time": "2026-11-26T10:15:27.200Z", "lat": 49.0, "lon": 8.4}
    report |= {draw.choice(NAMES): draw.choice(VALUES) for _ in range(draw.randrange(4))}
    return json.dumps(report, separators=(",", ":")).encode() + b"\n"


MAKERS: dict[str, Callable[[random.Random], bytes]] = {"nmea": nmea, "ubx": ubx, "gpsd": gpsd}
WHOLE = {
    "nmea": b"$GPTXT,whole*1A\r\n",
    "ubx": b"\xb5b\x05\x01\x02\x00\x06\x01\x0f\x38",
    "gpsd": b'{"class":"VERSION","release":"3.25"}\n',
}


@dataclass
class Outcome:
    """Fate of one format's frames. lost: valid ones not read."""

    format: str
    cases: int
    read: int
    malformed: int
    broken_bytes: int
    lost: int
    us: float


def spoil(draw: random.Random, data: bytes) -> bytes:
    """Flip, cut, overwrite, or keep."""
    at = draw.randrange(len(data))
    match draw.randrange(5):
        case 0:
            return data[:at] + bytes([data[at] ^ 1 << draw.randrange(8)]) + data[at + 1 :]
        case 1:
            return data[:at]
        case 2:
            return data[:at] + draw.randbytes(draw.randrange(1, 9)) + data[at + 4 :]
        case 3:
            return data[at:] + draw.choice((b"\xb5b\x01\x07\xff\x0f", b"$GN", b'{"class":', b"\xb5", b"$" * 9))
    return data


def run(format_: str, cases: int, seed: int = 0) -> Outcome:
    """Feed frames in pieces of any size, a valid one after every tenth."""
    draw, line, framer = random.Random(f"{format_} {seed}"), Line(format_, FEEDS), Framer(FRAMINGS)
    whole, stream, sent, read, used_s = WHOLE[format_], bytearray(), 0, 0, 0.0
    for i in range(cases):
        stream += spoil(draw, MAKERS[format_](draw))
        if i % 10 < 9 and i < cases - 1:
            continue
        stream += whole
        sent += 1
        while stream:
            piece = bytes(stream[: draw.randrange(1, 600)])
            del stream[: len(piece)]
            read += sum(frame.data in whole for frame in framer.feed(piece))
            began_s = time.process_time()
            line.feed(piece, (i + 1) * 10**8)
            used_s += time.process_time() - began_s
    counters = line.counters
    frames, malformed = counters.get(f"frames_{format_}", 0), counters.get("malformed", 0)
    return Outcome(format_, cases, frames, malformed, counters["bytes_broken"], sent - read, used_s / cases * 1e6)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.frames", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, help="frames of each format")
    parser.add_argument("--format", choices=MAKERS, help="only this one")
    parser.add_argument("--seed", type=int, default=0, help="other frames")
    arguments = parser.parse_args()
    outcomes = [run(name, arguments.cases, arguments.seed) for name in MAKERS if arguments.format in (None, name)]
    for outcome in outcomes:
        print(outcome)
    return 1 if any(outcome.lost for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
