"""What is on a line: formats, message rates, place and time from its receiver. Pure."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

from agents.corrections.rtcm import RTCM, RTCM_FRAMING, message_number
from agents.drivers.formats import FIX, HEADING, IMU, STREAMS, VELOCITY, Message
from agents.drivers.formats.framing import FRAMINGS, GPSD, NMEA, UBX, Frame, Framer
from agents.drivers.line import DECODERS
from agents.drivers.receiver import why_unplaced

UBX_NAMES = {(1, 7): "NAV-PVT", (1, 60): "NAV-RELPOSNED", (16, 2): "ESF-MEAS", (16, 3): "ESF-RAW"}
# Streams expected after a first fix, by message.
PROMISED = {
    "NAV-PVT": (FIX, VELOCITY),
    "NAV-RELPOSNED": (HEADING,),
    "GGA": (FIX,),
    "RMC": (VELOCITY,),
    "HDT": (HEADING,),
    "THS": (HEADING,),
    "TPV": (FIX, VELOCITY),
}
# Unsupported formats, by sync bytes.
FOREIGN = {b"$@": "SBF (Septentrio)", b"\xaaD\x12": "NovAtel's binary", b"\xa0\xa2": "SiRF's binary"}
ENGINE = "engine"  # a bus stream
MANY, MOST_BETWEEN = 3, 2000  # so many sync matches, at most so many bytes apart, are no coincidence
NO_PORT = "no serial port is there: plug a receiver in, or name an address (tcp://HOST:PORT, udp://:PORT, gpsd, a file)"


@dataclass(frozen=True)
class HeardLine:
    """What was heard on a line.

    kind: of its [[driver]]; empty: none. messages: rates [Hz]. streams: usable ones. place: newest fix, latitude,
    longitude [deg], height [m], or empty. accuracy_m: standard deviation, None: not stated. utc_ns: 0: no time.
    problem: what prevents use.
    """

    address: str
    kind: str = ""
    baud: int = 0
    messages: Mapping[str, float] = field(default_factory=dict)
    streams: tuple[str, ...] = ()
    place: tuple[float, ...] = ()
    accuracy_m: float | None = None
    quality: str = ""
    satellites: int = 0
    utc_ns: int = 0
    problem: str = ""


class Ear:
    """Analyses one line's bytes. n_bytes: so far; frames: complete ones."""

    def __init__(self) -> None:
        self.n_bytes = self.frames = 0
        self._framer = Framer({**FRAMINGS, RTCM: RTCM_FRAMING})
        self._decoders = {name: make(()) for name, make in DECODERS.items()}
        self._rates: dict[str, _Rate] = {}  # by format and message
        self._streams: dict[str, set[str]] = {name: set() for name in DECODERS}
        self._senders: set[str] = set()  # of positions
        self._foreign: Counter[str] = Counter()
        self._seen: Message | None = None
        self._utc_ns = 0

    def hears(self, format_: str) -> bool:
        """Whether frames of this format arrived."""
        return any(name.startswith(f"{format_} ") for name in self._rates)

    def feed(self, data: bytes, host_ns: int | None) -> None:
        """Take bytes; the last arrived at `host_ns`, host clock, None: from a file."""
        self.n_bytes += len(data)
        self._foreign.update({name: data.count(sync) for sync, name in FOREIGN.items()})
        for frame in self._framer.feed(data):
            self.frames += 1
            name = _name(frame)
            rate = self._rates.setdefault(f"{frame.format} {name}", _Rate())
            rate.take((self._utc_ns if host_ns is None else host_ns) * 1e-9)
            if frame.format in DECODERS:
                self._streams[frame.format].update(PROMISED.get(name[-3:] if frame.format == NMEA else name, ()))
                self._decode(frame, host_ns or self._utc_ns)

    def heard(self, address: str, baud: int = 0) -> HeardLine:
        """Result so far."""
        rates = {name: rate.hz for name, rate in sorted(self._rates.items())}
        kind = max(self._streams, key=lambda name: (len(self._streams[name]), name == UBX))
        streams = tuple(stream for stream in STREAMS if stream in self._streams[kind])
        if not streams:
            return HeardLine(address, baud=baud, messages=rates, problem=self._why_useless())
        problem = why_unplaced(self._seen) if FIX in streams else ""
        if len(self._senders) > 1:
            one, *_ = senders = sorted(self._senders)
            several = f'{", ".join(senders)} send positions over one line: feed each by its own, as "{one}:fix"'
            problem = problem or several
        fix = self._seen or Message(FIX, "", 0)
        std_m = math.sqrt(sum(fix.values[3:5]) / 2)
        stated_m = std_m if std_m > 0 else None  # NaN: not stated
        shown = (fix.values[:3], stated_m, fix.quality, fix.satellites)
        return HeardLine(address, kind, baud, rates, streams, *shown, self._utc_ns, problem)

    def _decode(self, frame: Frame, host_ns: int) -> None:
        try:
            messages = self._decoders[frame.format].decode(frame.data, host_ns)
        except (ValueError, ArithmeticError):
            return
        for message in messages:
            self._utc_ns = message.utc_ns or self._utc_ns
            if message.stream in STREAMS:
                self._streams[frame.format].add(message.stream)
            if message.stream == FIX:
                self._seen = message
                self._senders.add(_sender(frame))

    def _why_useless(self) -> str:
        """Why no driver reads it."""
        if self.hears(RTCM):
            return "it sends corrections (RTCM3), and no position: a base, for the `source` of `sitegrid corrections`"
        if self.frames:
            return why_unplaced(None)
        if not self.n_bytes:
            return "nothing comes: is it powered, wired, and set to send here?"
        foreign, n = max(self._foreign.items(), key=lambda item: item[1])
        if n >= MANY and self.n_bytes <= n * MOST_BETWEEN:
            return f"it sends {foreign}, which no driver reads: set it to send NMEA, or UBX"
        return "bytes come, but neither NMEA, UBX, gpsd's nor RTCM3 at any baud: is it a receiver, set to send those?"


@dataclass
class _Rate:
    """Messages between the first and last with known time [s]."""

    n: int = 0
    first_s: float = 0.0
    last_s: float = 0.0

    def take(self, at_s: float) -> None:
        if not self.first_s:
            self.n, self.first_s = 0, at_s
        self.n, self.last_s = self.n + 1, at_s

    @property
    def hz(self) -> float:
        """0 for a single message."""
        return round((self.n - 1) / (self.last_s - self.first_s), 2) if self.last_s > self.first_s else 0.0


def _name(frame: Frame) -> str:
    """A frame's name in its format."""
    data = frame.data
    if frame.format == UBX:
        return UBX_NAMES.get((data[2], data[3]), f"{data[2]:02X}-{data[3]:02X}")
    if frame.format == NMEA:
        return data[1:-3].partition(b",")[0].decode("ascii", "replace")
    return str(message_number(data)) if frame.format == RTCM else str(json.loads(data).get("class"))


def _sender(frame: Frame) -> str:
    """Sender on a shared line."""
    if frame.format == NMEA:
        return frame.data[1:3].decode("ascii", "replace").lower()
    return str(json.loads(frame.data).get("device", "")) if frame.format == GPSD else ""


def block(heard: HeardLine) -> list[str]:
    """Address, contents and problem, as lines."""
    baud = f" at {heard.baud} baud" if heard.baud else ""
    rates = ", ".join(f"{name} {f'{hz:g} Hz' if hz else 'once'}" for name, hz in heard.messages.items())
    said = [f"{heard.kind or 'no driver reads this'}{baud}: {rates}"] if heard.messages else []
    if heard.streams:
        said.append(f"feeds: {', '.join(heard.streams)}")
    if heard.place:
        lat_deg, lon_deg, height_m = heard.place
        accuracy = "accuracy not stated" if heard.accuracy_m is None else f"within {heard.accuracy_m:.2g} m"
        fix = f"{heard.quality}, {heard.satellites} satellites, {accuracy}"
        said.append(f"fix: {fix}, at {lat_deg:.6f} {lon_deg:.6f}, {height_m:.1f} m")
    if heard.utc_ns:
        said.append(f"time: {datetime.fromtimestamp(heard.utc_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    return [heard.address, *(f"  {line}" for line in (*said, heard.problem) if line)]


def missing(every: Sequence[HeardLine]) -> dict[str, str]:
    """What an agent on these lines cannot know, a sentence each."""
    streams = {stream for heard in every for stream in heard.streams}
    lacks = {} if FIX in streams else {"position": "no receiver: no position, so no sample"}
    if IMU not in streams:
        lacks["slope"] = "no IMU: no slope (of a u-blox with one: switch on ESF-MEAS or ESF-RAW)"
    rest = "slope only" if IMU in streams else "no rolling resistance"
    if ENGINE in streams:
        return lacks
    return lacks | {"resistance": f"no torque: {rest} (the machine's bus has it, or a driver of your own, or a log)"}
