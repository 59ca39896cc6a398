"""Reports of gpsd, JSON objects in lines, to messages. Pure.

Its error estimates (`epx`, `epy`, `eph`, `eps`) are no standard deviations; a fed sensor states its own (`std`).
"""

import json
import math
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from typing import Any

from agents.drivers import formats
from agents.drivers.formats import Message

GPSD_PORT = 2947  # default port
GREETING = b'?WATCH={"enable":true,"json":true};\n'  # requests reports
QUALITIES = {1: "autonomous", 2: "differential", 3: "fixed", 4: "float"}  # by `status`
PLANE, SPACE = 2, 3  # `mode` of 2-D and 3-D fixes


class GpsdDecoder:
    """Decodes one gpsd's reports. devices: receivers of their own; all others count as one."""

    def __init__(self, devices: Collection[str] = ()) -> None:
        self._devices = frozenset(devices)
        self._satellites = 0

    def decode(self, frame: bytes, _: int) -> Sequence[Message]:
        """Messages of a report; none of unused classes."""
        report = json.loads(frame)
        if report["class"] == "SKY":
            self._satellites = int(_number(report, "uSat", self._satellites))
        return self._fix(report) if report["class"] == "TPV" else ()

    def _fix(self, report: dict[str, Any]) -> Sequence[Message]:
        device = report.get("device")
        source = device.lower() if isinstance(device, str) and device.lower() in self._devices else ""
        if report.get("mode") not in (PLANE, SPACE) or "time" not in report:
            return (Message(formats.FIX, source, 0, satellites=self._satellites),)
        time = datetime.fromisoformat(str(report["time"]))
        utc_ns = formats.rolled_over(round(time.replace(tzinfo=time.tzinfo or UTC).timestamp() * 1e6) * 1000)
        quality = QUALITIES.get(int(_number(report, "status", 1.0)), "autonomous")
        height_m = _number(report, "altHAE", _number(report, "alt", 0.0))
        place = (_number(report, "lat"), _number(report, "lon"), height_m, *(math.nan,) * 3)
        moving = formats.velocity(_number(report, "speed"), math.radians(_number(report, "track", 0.0)), math.nan)
        return (
            Message(formats.TIME, source, utc_ns),
            Message(formats.FIX, source, utc_ns, place, quality=quality, satellites=self._satellites),
            Message(formats.VELOCITY, source, utc_ns, moving),
        )


def _number(report: dict[str, Any], name: str, otherwise: float = math.nan) -> float:
    value = report.get(name, otherwise)
    if type(value) not in (int, float):
        raise ValueError(f"{name}: {value!r:.40} is no number")
    return float(value)
