"""Receivers' bytes by the simulator's writers (checked against oracles), and a scripted source."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pyubx2 import GET, UBXMessage

from agents.drivers import Driver, Observed
from sim.receivers.ubx import NavPvt, esf_meas
from tests.paths import SHARED_DATA

TEN = 1_795_688_127  # 2026-11-26 10:15:27 UTC [s]
PVT = NavPvt(
    itow_ms=382_545_000,
    year=2026,
    month=11,
    day=26,
    hour=10,
    minute=15,
    second=27,
    valid=7,
    fix_type=3,
    flags=1 | 1 << 1 | 2 << 6,
    satellites=24,
    lon_1e7=84_005_678,
    lat_1e7=490_101_234,
    height_mm=157_300,
    sea_height_mm=110_200,
    north_mmps=120,
    east_mmps=2150,
    down_mmps=-3,
    speed_mmps=2153,
    course_1e5=8_680_000,
    horizontal_acc_mm=14,
    vertical_acc_mm=19,
    speed_acc_mmps=35,
)
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


def report(values: dict[str, Any]) -> bytes:
    """In gpsd's form."""
    return json.dumps(values, separators=(",", ":")).encode() + b"\r\n"


def ubx(name: str, **values: Any) -> bytes:
    return UBXMessage(name.partition("-")[0], name, GET, **values).serialize()


def pvt(**values: int) -> bytes:
    """NAV-PVT with changed fields of NavPvt."""
    return PVT._replace(**values).frame()


def esf(tag: int, *data: tuple[int, int]) -> bytes:
    return esf_meas(tag, data)


def spoiled(frames: list[bytes], seed: int = 1) -> tuple[bytes, int]:
    """The frames as a stream with 16 % broken, and the number of whole ones."""
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
    """A real receiver's recording, or skip."""
    path = SHARED_DATA / "recordings" / name
    if not path.is_file():
        pytest.skip(f"the recording is not beside the project (../shared/data/recordings/{name})")
    return path


def no_bundles() -> Driver:
    raise AssertionError("no table is of kind zenoh")


class Script:
    """A source of given pieces."""

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
