"""One line: bytes to sensor values, by the streams of a [[driver]] table. Pure."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping

from agents.drivers import Observed
from agents.drivers.formats import FIX, STREAMS, TIME, Decoder, Message
from agents.drivers.formats.framing import FRAMINGS, GPSD, NMEA, UBX, Frame, Framer
from agents.drivers.formats.gpsd import GpsdDecoder
from agents.drivers.formats.nmea import NmeaDecoder
from agents.drivers.formats.ubx import UbxDecoder
from agents.drivers.time_base import ClockTie
from protocol.machine.machine_config import QUANTITIES, SensorConfig
from protocol.machine.readings import columns

DECODERS: dict[str, Callable[[Collection[str]], Decoder]] = {NMEA: NmeaDecoder, UBX: UbxDecoder, GPSD: GpsdDecoder}


class Line:
    """Decodes the bytes of one line.

    feeds: sensor by stream, `heading`, or `gp:fix` of one sender. frames: whole ones by format. seen: newest fix
    message.
    """

    def __init__(self, format_: str, feeds: Mapping[str, SensorConfig]) -> None:
        self.frames: Counter[str] = Counter()
        self.seen: Message | None = None
        self._format = format_
        self._feeds = {split_stream(key): sensor for key, sensor in feeds.items()}
        self.has_fixes = any(stream == FIX for _, stream in self._feeds)
        self._decoder = DECODERS[format_]({source for source, _ in self._feeds})
        self._framer = Framer(FRAMINGS)
        self._counters: Counter[str] = Counter()
        self._ties: dict[str, ClockTie] = {}  # of sensors' own clocks, by stream
        self._file_ns = 0

    def feed(self, data: bytes, host_ns: int | None, byte_ns: float = 0.0) -> list[Observed]:
        """Values in these bytes, the last of which came at `host_ns`; None for a file.

        byte_ns: duration of a byte. A value's time is its frame's begin; in a file, the last stated time.
        """
        observed: list[Observed] = []
        for frame in self._framer.feed(data):
            self.frames[frame.format] += 1
            if frame.format == self._format:
                waited_ns = round((frame.after + len(frame.data)) * byte_ns)
                observed += self._take(frame, None if host_ns is None else host_ns - waited_ns)
        return observed

    @property
    def counters(self) -> dict[str, int]:
        """Frames by format, bytes in none, malformed frames, missing fixes."""
        frames = {f"frames_{name}": n for name, n in dict(self.frames).items()}
        return {**frames, "bytes_broken": self._framer.broken, **dict(self._counters)}

    def _take(self, frame: Frame, host_ns: int | None) -> list[Observed]:
        try:
            messages = self._decoder.decode(frame.data, self._file_ns if host_ns is None else host_ns)
        except (ValueError, ArithmeticError):
            self._counters["malformed"] += 1
            return []
        return [value for message in messages if (value := self._observed(message, host_ns))]

    def _observed(self, message: Message, host_ns: int | None) -> Observed | None:
        if host_ns is None:
            host_ns = self._file_ns = message.utc_ns or self._file_ns
            if not host_ns:
                return None  # the file has not stated a time yet
        if message.tag_ns is not None:
            host_ns = self._undelayed_ns(message.stream, message.tag_ns, host_ns)
        if message.stream == TIME:
            return Observed("", "", (), host_ns, message.utc_ns)
        if message.stream == FIX:
            self.seen = message
            if not message.utc_ns:
                self._counters["undated_fix" if message.values else "no_fix"] += 1
                return None
        sensor = self._feeds.get((message.source, message.stream))
        if sensor is None:
            return None
        values = message.values
        if any(map(math.isnan, values)) and any(map(math.isnan, values := stated(values, sensor))):
            self._counters["without_value"] += 1
            return None
        return Observed(sensor.name, STREAMS[message.stream], values, host_ns, message.utc_ns)

    def _undelayed_ns(self, stream: str, tag_ns: int, host_ns: int) -> int:
        tie = self._ties.setdefault(stream, ClockTie())
        is_new = host_ns > tie.heard_ns or not self._file_ns  # in a file, only the first after a stated time came then
        if is_new and not tie.take(tag_ns, host_ns):
            return host_ns
        return host_ns if tie.offset_ns is None else tag_ns - tie.offset_ns


def stated(values: tuple[float, ...], sensor: SensorConfig) -> tuple[float, ...]:
    """Values with the sensor's own variance where the sender states none."""
    std = sensor.std.get(QUANTITIES.get(sensor.kind, ("",))[-1], math.nan)
    named = zip(values, columns(sensor.kind), strict=True)
    return tuple(std * std if math.isnan(value) and name.startswith("var_") else value for value, name in named)


def split_stream(key: str) -> tuple[str, str]:
    """Sender (lower case, empty for any) and stream of a key in `feeds`."""
    source, _, stream = key.rpartition(":")
    return source.lower(), stream
