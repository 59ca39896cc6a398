"""Recorded readings, bit-exact, in the agent's order."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from protocol.errors import ConfigError, MessageError
from protocol.machine.readings import KINDS, Gps, Reading, columns, parse_reading
from protocol.recording import Message, RecordedFile, Recording, time_of
from protocol.site.site_config import NAME

LOCATION_FIX = "foxglove.LocationFix"
PREFIX = "sitegrid."  # of other schemas
TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
NUMBER, TEXT = {"type": "number"}, {"type": "string"}
FIX_PROPERTIES: dict[str, Any] = {
    "timestamp": TIME,
    "frame_id": TEXT,
    **dict.fromkeys(("latitude", "longitude", "altitude"), NUMBER),
    "position_covariance": {"type": "array", "items": NUMBER},
    "position_covariance_type": {"type": "integer"},
}
DIAGONAL = slice(None, None, 4)  # of a 3 x 3 matrix, row by row
COVARIANCE_DIAGONAL = 2  # Foxglove's code for a known diagonal
COLUMNS = {kind: columns(kind) for kind in KINDS}
SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    kind: (PREFIX + kind, {"timestamp": TIME, **dict.fromkeys(names, NUMBER)}) for kind, names in COLUMNS.items()
} | {Gps.kind: (LOCATION_FIX, FIX_PROPERTIES)}


class RecordedReading(NamedTuple):
    """A machine's reading. log_ns: when its agent took it, by the host clock."""

    machine: str
    log_ns: int
    reading: Reading


def record_reading(recording: Recording, machine: str, log_ns: int, reading: Reading) -> None:
    """Add a reading to a recording."""
    schema, properties = SCHEMAS[reading.kind]
    values = {"timestamp": time_of(reading.stamp_ns), **_values_of(reading)}
    topic, data = f"/machine/{machine}/readings/{reading.sensor}", json.dumps(values).encode()
    recording.write(Message(topic, schema, log_ns, reading.stamp_ns, data), properties)


def _values_of(reading: Reading) -> dict[str, Any]:
    if not isinstance(reading, Gps):
        return {name: getattr(reading, name) for name in COLUMNS[reading.kind]}
    covariance = (reading.var_e_m2, 0.0, 0.0, 0.0, reading.var_n_m2, 0.0, 0.0, 0.0, reading.var_u_m2)
    place = (reading.lat_deg, reading.lon_deg, reading.height_m)
    return fix_of(reading.sensor, place, covariance, COVARIANCE_DIAGONAL)


def fix_of(
    frame: str, place: tuple[float, float, float], covariance: tuple[float, ...], covariance_type: int
) -> dict[str, Any]:
    """A Foxglove LocationFix. place: latitude, longitude [deg], height [m]. covariance: (9,) [m2]."""
    named = dict(zip(("latitude", "longitude", "altitude"), place, strict=True))
    return {
        "frame_id": frame,
        **named,
        "position_covariance": covariance,
        "position_covariance_type": covariance_type,
    }


def readings_of(file: RecordedFile | Path) -> Iterator[RecordedReading]:
    """Readings of all machines in a recording; other messages are skipped. ConfigError if damaged."""
    recorded = file if isinstance(file, RecordedFile) else RecordedFile(file)
    for message in recorded.messages():
        if reading := reading_of(message, recorded.path):
            yield reading


def reading_of(message: Message, path: Path) -> RecordedReading | None:
    """A message's reading, or None; ConfigError, with the file, if damaged."""
    _, *words = message.topic.split("/")
    kind = Gps.kind if message.schema == LOCATION_FIX else message.schema.removeprefix(PREFIX)
    if len(words) != 4 or words[::2] != ["machine", "readings"] or kind not in KINDS:
        return None
    machine, sensor = words[1::2]
    try:
        if not (NAME.fullmatch(machine) and NAME.fullmatch(sensor)):
            raise ValueError("no name")
        values = tuple(map(float, _values(kind, json.loads(message.data))))
        return RecordedReading(machine, message.log_ns, parse_reading(kind, sensor, message.stamp_ns, values))
    except (ValueError, TypeError, KeyError, RecursionError, MessageError) as error:
        raise ConfigError(path, f"a message of {message.topic[:70]} is no reading: {error!r:.100}") from None


def _values(kind: str, table: Any) -> tuple[Any, ...]:
    if kind != Gps.kind:
        return tuple(table[name] for name in COLUMNS[kind])
    return (table["latitude"], table["longitude"], table["altitude"], *table["position_covariance"][DIAGONAL])
