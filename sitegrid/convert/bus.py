"""Recordings of a machine's bus, by the agent's driver."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from agents.drivers.can.buses import read_recording
from agents.drivers.can.line import CanLine
from agents.drivers.can.pgns import SIGNALS, group_name
from agents.drivers.can.source import take
from agents.drivers.can.streams import STREAMS
from protocol.errors import LogFolderError
from sitegrid.convert.receivers import sensor_of, unstated
from sitegrid.convert.recording import Topic, Value
from sitegrid.setup.hearing_bus import heard_bus

# Alternatives: the first with values is taken, the others offered.
ALIKE = (("rear_speed", "speed"), ("gearbox", "clutch"))


class BusRecording:
    """CAN frames in a file, one topic per stream with values."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            heard = heard_bus(path.name, read_recording(str(path)))
        except OSError as error:
            raise LogFolderError(path, str(error.strerror)) from None
        if not heard.streams:
            raise LogFolderError(path, heard.problem)
        second = {name for names in ALIKE for name in [one for one in names if one in heard.streams][1:]}
        self.topics = [_topic(name, is_sure=name not in second) for name in heard.streams]
        self.unread: list[str] = []

    def values(self, wanted: Collection[tuple[str, str]]) -> Iterator[Value]:
        """Values of streams."""
        line = CanLine({name: sensor_of(name, kind) for name, kind in wanted}, SIGNALS)
        try:
            for frame in read_recording(str(self._path)):
                for seen in take(line, frame, round(frame.utc_s * 1e9)):
                    yield Value(seen.sensor, seen.kind, seen.host_ns, unstated(seen.kind, seen.values))
        except OSError as error:
            self.unread.append(f"what follows: it cannot be read further ({error.strerror})")
        self.unread += [f"{n} {name.replace('_', ' ')}" for name, n in line.counters.items() if "without" in name]


def _topic(name: str, *, is_sure: bool) -> Topic:
    stream = STREAMS[name]
    groups = ", ".join(dict.fromkeys(group_name(SIGNALS[signal].group) for signal in stream.begins))
    measures = {"turn_rate": ("rate",)}.get(name, ("speed",)) if stream.kind == "odometry" else ()
    sure = (stream.kind,) if is_sure else ()
    return Topic(name, groups, {stream.kind: f"{name} of {groups}"}, sure, measures=measures)
