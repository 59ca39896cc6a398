"""One recording into one log folder, with a report of sensors, contents and manual work left."""

from __future__ import annotations

import re
from argparse import Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.drivers.can.buses import is_recording
from protocol.errors import ConfigError, LogFolderError, MessageError, one_line
from protocol.files import whole_folder
from protocol.machine.log_columns import VARIANCES
from protocol.machine.log_folder import MANIFEST, log_files, manifest_toml, open_log
from protocol.machine.machine_config import BASE, BEFORE_THE_WHEELS, QUANTITIES, MachineConfig, SensorConfig
from protocol.machine.readings import Imu, Odometry, columns, parse_reading
from protocol.site.site_config import SiteConfig
from sitegrid.convert.bus import BusRecording
from sitegrid.convert.gpx import GpxRecording
from sitegrid.convert.receivers import ReceiverRecording
from sitegrid.convert.recording import Recording, Topic, Value
from sitegrid.convert.ros import BAG, MCAP, SQLITE, RosRecording, split_joints
from sitegrid.convert.ros_messages import MOST_JOINTS
from sitegrid.process.lifetime import raise_interrupts, say, tell
from sitegrid.process.streams import table
from sitegrid.times import iso

Takes = Sequence[tuple[str, tuple[str, ...]]]
NONE = "none"  # kind that takes nothing of a topic
NOT_STATED = 1.0  # variance for limit checks if none is stated
BODY = "[machine]: mass, wheels and the like are those of a wheel loader of 17.5 t: write those of this machine"


@dataclass
class Sensor:
    """A file of the log folder being written.

    source: topic, with joints. back: rows stamped before an earlier one. unstated: rows without a variance.
    """

    topic: Topic
    source: str
    kind: str
    name: str
    rows: int = 0
    first_ns: int = 0
    newest_ns: int = 0
    back: int = 0
    unstated: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    first_refused: dict[str, str] = field(default_factory=dict)

    def take(self, value: Value) -> bool:
        """Count a value; returns whether it is a reading."""
        named = list(zip(columns(self.kind), value.values, strict=not value.problem))
        try:
            if value.problem:
                raise ValueError(value.problem)
            stated = tuple(v or NOT_STATED if name.startswith("var_") else v for name, v in named)
            parse_reading(self.kind, self.name, value.stamp_ns, stated)
        except (MessageError, ValueError) as error:
            reason = str(error.reason) if isinstance(error, MessageError) else value.problem
            self.refused[reason] += 1
            self.first_refused.setdefault(reason, str(error))
            return False
        self.unstated += any(not v for name, v in named if name in VARIANCES.get(self.kind, ()))
        self.back += value.stamp_ns < self.newest_ns
        self.first_ns, self.newest_ns = self.first_ns or value.stamp_ns, max(self.newest_ns, value.stamp_ns)
        self.rows += 1
        return True

    def row(self) -> dict[str, Any]:
        """A row of the report."""
        seconds = (self.newest_ns - self.first_ns) * 1e-9
        rate_hz = round((self.rows - 1) / seconds, 2) if seconds > 0 else None
        taken = {"topic": one_line(self.source), "type": self.topic.type, "sensor": self.name, "kind": self.kind}
        return {
            **taken,
            "rows": self.rows,
            "rate_hz": rate_hz,
            "begins": iso(self.first_ns),
            "fields": self.topic.kinds[self.kind],
        }


def run(arguments: Namespace) -> int:
    """Convert and report."""
    raise_interrupts()  # incomplete output is removed
    folder = arguments.folder or Path(arguments.file.stem)
    report = convert(arguments.file, folder, arguments.take)
    if arguments.json:
        say(report)
    else:
        took = [f"{row['sensor']}: {row.pop('fields')}, from {row.pop('begins')}" for row in report["took"]]
        left = [f"left out: {line}" for line in report["left_out"]]
        to_do = [f"to do: {line}" for line in report["to_do"]]
        tell(table(report["took"]), "", *took, *left, *to_do, "")
        tell(f"written: {folder / MANIFEST}. Then: sitegrid log check {folder}")
    return 0


def convert(file: Path, folder: Path, takes: Takes = ()) -> dict[str, Any]:
    """Write a recording's log folder; returns what was taken, omitted, and is left to do.

    takes: kinds by topic. Raises ConfigError, LogFolderError, OSError.
    """
    if folder.exists():
        raise ConfigError(folder, "exists, and stays as it is: name another folder, or remove it")
    recording = open_recording(file)
    sensors, left = choose(recording.topics, takes)
    with whole_folder(folder) as part:
        first_fix = _write(recording, sensors, part)
        left += [line for sensor in sensors for line in _refusals(sensor)]
        for sensor in [sensor for sensor in sensors if not sensor.rows]:
            (part / f"{sensor.name}.csv").unlink()
            sensors.remove(sensor)
        if not sensors:
            raise LogFolderError(file, f"nothing in it can be used: {'; '.join([*left, *recording.unread]) or 'empty'}")
        site, configs = _site(_name(folder), first_fix, file), [_config(sensor) for sensor in sensors]
        machine = MachineConfig(site.name, sensors=tuple(config for config, _ in configs))
        origin = f"[site]: its origin is the first fix, {site.origin_lat_deg}, {site.origin_lon_deg}"
        notes = {"": [f"of {file.name}", origin, BODY]}
        notes |= {config.name: to_do for config, to_do in configs}
        (part / MANIFEST).write_text(manifest_toml(site.name, site, machine, notes), encoding="utf-8")
        open_log(part)
    to_do = [one_line(f"{name}: {line}".removeprefix(": ")) for name, lines in notes.items() for line in lines[1:]]
    left = list(map(one_line, [*left, *recording.unread]))
    return {"folder": str(folder), "took": [sensor.row() for sensor in sensors], "left_out": left, "to_do": to_do}


def open_recording(file: Path) -> Recording:
    """Open a recording of any type; otherwise LogFolderError."""
    is_folder = (file / "metadata.yaml").is_file()
    if not is_folder and not file.is_file():
        raise LogFolderError(file, "is neither a file nor the folder of a bag of ROS 2, with metadata.yaml")
    head = b"" if is_folder else _head(file)
    if is_recording(file.name) and (file.suffix != ".log" or head.startswith(b"(")):  # receivers use .log too
        return BusRecording(file)
    if head.startswith(MCAP) and b"ros2" not in head[:40]:
        raise LogFolderError(file, "is an MCAP file, but not of ROS 2")
    if is_folder or head.startswith((BAG, MCAP, SQLITE)):
        return RosRecording(file, is_ros1=head.startswith(BAG))
    return GpxRecording(file) if b"<gpx" in head else ReceiverRecording(file)


def _head(file: Path) -> bytes:
    with file.open("rb") as opened:
        if head := opened.read(4096):
            return head
    raise LogFolderError(file, "is empty")


def choose(topics: Sequence[Topic], takes: Takes) -> tuple[list[Sensor], list[str]]:
    """Sensors to write, and reasons by omitted topic; ConfigError if somebody must choose."""
    asked = [(topic, source, kind) for source, kinds in takes for topic, kind in _asked(topics, source, kinds)]
    named = {split_joints(source)[0] for source, _ in takes}
    chosen, left, open_questions = list(asked), list[str](), list[str]()
    for topic in topics:
        alike = [other for other in topics if other.type == topic.type and set(other.sure) & set(topic.sure)]
        is_other = any(other.type == topic.type and set(other.kinds) & set(topic.kinds) for other, _, _ in asked)
        if topic.name not in named and is_other:
            left.append(f"{topic.name}: another {topic.type} is taken")
            continue
        if topic.name not in named and (topic.question or len(alike) > 1):
            why = topic.question or f"{len(alike)} of {topic.type}: two sensors, or one twice"
            open_questions.append(f"{topic.name} ({why}): --take {topic.name}={'|'.join((*topic.kinds, NONE))}")
        elif topic.name not in named:
            chosen += [(topic, topic.name, kind) for kind in topic.sure]
        taken = [kind for other, _, kind in chosen if other is topic]
        is_part = bool(taken) or not (topic.sure or topic.question)
        left += [_offer(topic, kind) for kind in topic.kinds if kind not in taken and is_part]
    if open_questions:
        raise ConfigError("choose", f"what is it? {'; '.join(open_questions)}")
    names = Counter[str]()
    sensors = []
    for topic, source, kind in chosen:
        names[kind] += 1
        number = f"-{names[kind]}" if names[kind] > 1 else ""
        sensors.append(Sensor(topic, source, kind, kind.replace("_", "-") + number))
    return sensors, left


def _offer(topic: Topic, kind: str) -> str:
    joints = f"[{','.join(topic.joints)}]" if topic.joints else ""
    return f"{topic.name}{joints} as {kind} ({topic.kinds[kind]}): --take '{topic.name}{joints}={kind}' takes it"


def _asked(topics: Sequence[Topic], source: str, kinds: Sequence[str]) -> Iterator[tuple[Topic, str]]:
    """Topics and kinds of one --take; ConfigError if there are none."""
    name, joints = split_joints(source)
    topic = next((topic for topic in topics if topic.name == name), None)
    if topic is None:
        raise ConfigError("--take", f"no topic {name} can be taken; there are {', '.join(t.name for t in topics)}")
    for kind in kinds:
        if kind == NONE:
            continue
        if kind not in topic.kinds:
            raise ConfigError("--take", f"{name} is no {kind}; it can be {', '.join((*topic.kinds, NONE))}")
        most = MOST_JOINTS.get(kind, len(topic.joints))
        if len(joints) > most or not set(joints) <= set(topic.joints) or bool(joints) != bool(topic.joints):
            named = f"{name}[{','.join(topic.joints[:most])}]={kind}' ({', '.join(topic.joints) or 'it has no joints'})"
            raise ConfigError("--take", f"{source}={kind}: name at most {most} of its joints, as '{named}")
        yield topic, kind


def _write(recording: Recording, sensors: Sequence[Sensor], folder: Path) -> tuple[float, ...]:
    """Write all sensors' files; returns the first fix: latitude, longitude [deg], height [m]."""
    by_source = {(sensor.source, sensor.kind): sensor for sensor in sensors}
    first: tuple[float, ...] = ()
    with log_files(folder, {sensor.name: sensor.kind for sensor in sensors}) as write:
        for value in recording.values(list(by_source)):
            sensor = by_source[value.topic, value.kind]
            if sensor.take(value):
                write(sensor.name, value.stamp_ns, value.values)
                first = first or (value.values[:3] if sensor.kind == "gps" else ())
    return first


def _site(name: str, fix: Sequence[float], file: Path) -> SiteConfig:
    if not fix:
        raise LogFolderError(file, "has no position, so no place for its site")
    lat, lon, height = (round(value, digits) for value, digits in zip(fix, (5, 5, 1), strict=True))
    return SiteConfig(name, lat, lon, height)


def _name(folder: Path) -> str:
    """The folder's name made valid for site, machine and log."""
    return re.sub("[^a-z0-9_-]+", "-", folder.absolute().name.lower()).strip("-_")[:63] or "recording"


def _config(sensor: Sensor) -> tuple[SensorConfig, list[str]]:
    """The manifest's sensor, and notes on its source and manual work."""
    topic, kind = sensor.topic, sensor.kind
    lacks = {"steering": "wheelbase_m", **dict.fromkeys(BEFORE_THE_WHEELS, "powertrain")}.get(kind, "")
    is_useless = bool(lacks) or sensor.unstated == sensor.rows
    to_do = [f"{sensor.source} ({topic.type}): {topic.kinds[kind]}", *([topic.note] if topic.note else [])]
    if sensor.back:
        to_do.append(f"{sensor.back} of {sensor.rows} stamps go back: see `sitegrid log check`")
    if sensor.unstated:
        std = f"`std = {{ {', '.join(f'{quantity} = ...' for quantity in QUANTITIES[kind])} }}`"
        to_do.append(f"{sensor.unstated} of {sensor.rows} rows state no error: write {std}")
    if lacks:
        to_do.append(f"it is of no use without `{lacks}` of [machine]: write that")
    if is_useless:
        to_do[-1] += ", then `use = true`"
    if topic.frame.lstrip("/") != BASE:
        frame = f"frame {topic.frame}" if topic.frame else "its frame"
        to_do.append(f"where {frame} is on the machine is not known: measure `mount`")
    measures = topic.measures if kind in (Imu.kind, Odometry.kind) else ()
    return SensorConfig(sensor.name, kind, use=not is_useless, measures=measures), to_do


def _refusals(sensor: Sensor) -> Iterator[str]:
    """Refused messages by reason."""
    total = sensor.rows + sensor.refused.total()
    for reason, n in sensor.refused.items():
        yield f"{sensor.source} as {sensor.kind}: {n} of {total} ({reason}), the first: {sensor.first_refused[reason]}"
    if not total:
        yield f"{sensor.source} as {sensor.kind}: no values"
