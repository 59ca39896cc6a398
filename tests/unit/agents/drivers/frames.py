"""Bytes as receivers send them, made by libraries that others wrote; and a source whose values are known."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pyubx2 import GET, UBXMessage

from agents.drivers import Observed
from tests.paths import SHARED_DATA

TEN = 1_795_688_127  # 2026-11-26 10:15:27 UTC [s]
DATE = {"year": 2026, "month": 11, "day": 26, "hour": 10, "min": 15, "second": 27}
VALID = {"validDate": 1, "validTime": 1, "fullyResolved": 1, "gnssFixOk": 1, "fixType": 3}
ACCURACY = {"hAcc": 14, "vAcc": 19, "sAcc": 35, "numSV": 24, "carrSoln": 2, "diffSoln": 1}
MOTION = {"velN": 120, "velE": 2150, "velD": -3, "gSpeed": 2153, "headMot": 86.8}
PLACE = {"lon": 8.4005678, "lat": 49.0101234, "height": 157_300, "hMSL": 110_200}
RMC = "GNRMC,101527.20,A,4900.6074040,N,00824.0340680,E,4.179,86.80,261126,,,R,V"
GGA = "GNGGA,101527.20,4900.6074040,N,00824.0340680,E,4,17,0.60,110.2,M,47.1,M,1.0,0001"
TPV = {
    "class": "TPV",
    "device": "/dev/ttyACM0",
    "mode": 3,
    "status": 2,
    "time": "2026-11-26T10:15:27.200Z",
    "lat": 49.0101234,
    "lon": 8.4005678,
    "altHAE": 157.3,
    "epx": 0.001,
    "speed": 2.15,
    "track": 90.0,
}


def nmea(text: str) -> bytes:
    """A sentence with its checksum."""
    checksum = 0
    for byte in text.encode():
        checksum ^= byte
    return f"${text}*{checksum:02X}\r\n".encode()


def report(values: dict[str, Any]) -> bytes:
    """As gpsd sends it."""
    return json.dumps(values, separators=(",", ":")).encode() + b"\r\n"


def ubx(name: str, **values: Any) -> bytes:
    return UBXMessage(name.partition("-")[0], name, GET, **values).serialize()


def pvt(**values: Any) -> bytes:
    return ubx("NAV-PVT", **{"iTOW": 382_545_000, **DATE, **VALID, **ACCURACY, **MOTION, **PLACE, **values})


def esf(tag: int, *data: tuple[int, int]) -> bytes:
    """ESF-MEAS of these data types and their fields, with the time that repeats the tag."""
    words = [(kind << 24) | (value & 0xFFFFFF) for kind, value in data]
    payload = b"".join(word.to_bytes(4, "little") for word in (tag, (len(words) << 11) | 1 << 3, *words, tag))
    return UBXMessage(0x10, 0x02, GET, payload=payload).serialize()


def spoiled(frames: list[bytes], seed: int = 1) -> tuple[bytes, int]:
    """A stream of these frames with 16 % of them broken, and how many are not."""
    draw, stream, whole = random.Random(seed), bytearray(), 0
    for i, frame in enumerate(frames):
        data = bytearray(frame)
        if i % 10 == 0:
            data[draw.randrange(1, len(data) - 2)] ^= 1 << draw.randrange(8)
        if i % 17 == 0:
            data = data[: draw.randrange(1, len(data) - 2)]
        whole += bytes(data) == frame
        stream += data
    return bytes(stream), whole


def recording(name: str) -> Path:
    """A recording of a real receiver, where it is at hand."""
    path = SHARED_DATA / "recordings" / name
    if not path.is_file():
        pytest.skip(f"the recording is not beside the project (../shared/data/recordings/{name})")
    return path


class Script:
    """A source that hands on these pieces."""

    def __init__(self, pieces: Sequence[Sequence[Observed]]) -> None:
        self._pieces = list(pieces)

    def read(self, timeout_s: float) -> Sequence[Observed] | None:
        return self._pieces.pop(0) if self._pieces else None

    def counters(self) -> dict[str, int]:
        return {}

    def problems(self) -> list[str]:
        return []

    def close(self) -> None:
        pass
