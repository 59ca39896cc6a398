"""Receiver bytes, NMEA and UBX, decoded by the agent's drivers."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from agents.drivers.formats import FIX, STREAMS
from agents.drivers.line import Line, split_stream
from protocol.errors import LogFolderError
from protocol.machine.machine_config import QUANTITIES, SensorConfig
from protocol.machine.readings import columns
from sitegrid.convert.recording import Topic, Value
from sitegrid.setup.hearing import Ear

PIECE = 65_536  # bytes per read
UNSTATED_STD = 1e3  # marks unstated variances: decoders drop values without one


class ReceiverRecording:
    """Receiver bytes in a file; separate topics for NMEA talkers if several state positions."""

    def __init__(self, path: Path) -> None:
        self._path = path
        ear = Ear()
        for piece in _pieces(path):
            ear.feed(piece, None)
        heard = ear.heard(path.name)
        if not heard.streams:
            raise LogFolderError(path, "is no bag of ROS, no MCAP, no GPX, and no receiver's positions are in it")
        self._format = heard.kind
        senders = sorted({name[-5:-3].lower() for name in heard.messages if name.endswith("GGA")})
        senders = senders if heard.kind == "nmea" and len(senders) > 1 else []
        self.topics = [self._topic(stream, senders) for stream in heard.streams]
        self.topics += [self._topic(f"{sender}:{stream}", senders) for sender in senders for stream in heard.streams]
        self.unread = [f"{name}: only {heard.kind} is" for name in heard.messages if not name.startswith(heard.kind)]

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of streams; `unread` counts broken and timeless messages."""
        topics = {f"s{i}": topic for i, (topic, _) in enumerate(wanted)}
        line = Line(self._format, {topic: sensor_of(f"s{i}", kind) for i, (topic, kind) in enumerate(wanted)})
        for piece in _pieces(self._path):
            for seen in line.feed(piece, None):
                if seen.sensor:
                    values = unstated(seen.kind, seen.values)
                    yield Value(topics[seen.sensor], seen.kind, seen.utc_ns or seen.host_ns, values)
        counted = {name.replace("_", " "): n for name, n in line.counters.items() if n and "frames" not in name}
        self.unread += [f"{self._format}: {n} {name}" for name, n in counted.items()]

    def _topic(self, name: str, senders: Collection[str]) -> Topic:
        stream = split_stream(name)[1]
        kind = STREAMS[stream]
        each = " ".join(f"--take {sender}:{FIX}={kind}" for sender in senders)
        several = f"{', '.join(senders)} send positions; of several receivers say {each}, of one receiver"
        note = "`ticks_per_rev` is not stated: count it" if kind == "encoder" else ""
        question = several if senders and name == FIX else ""
        return Topic(
            name, self._format, {kind: f"{stream} of {self._format}"}, () if senders else (kind,), question, note=note
        )


def sensor_of(name: str, kind: str) -> SensorConfig:
    """A sensor for values with or without variance."""
    is_stating = any(column.startswith("var_") for column in columns(kind))
    return SensorConfig(name, kind, std=dict.fromkeys(QUANTITIES[kind][-1:] if is_stating else (), UNSTATED_STD))


def unstated(kind: str, values: tuple[float, ...]) -> tuple[float, ...]:
    """Values of a kind; unstated variances become 0."""
    named = zip(columns(kind), values, strict=True)
    return tuple(0.0 if name.startswith("var_") and value == UNSTATED_STD**2 else value for name, value in named)


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            yield piece
