"""A site's messages with Foxglove's schemas for recordings; places in the frame `map`."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from protocol.machine.recorded_readings import FIX_PROPERTIES, LOCATION_FIX, NUMBER, TEXT, TIME, fix_of
from protocol.queries.answers import GroundChange
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile
from protocol.recording import Message, Recording, time_of
from protocol.site.site_config import Projection
from protocol.wire.messages import Health, Pose
from sitegrid.health import problems_of, status_of
from sitegrid.process.lifetime import plain

TRANSFORM, LOG, GRID = "foxglove.FrameTransform", "foxglove.Log", "foxglove.Grid"
COVARIANCE_KNOWN = 3  # Foxglove's codes: of covariances,
INFO, WARNING = 2, 3  # of log levels,
FLOAT32 = 7  # of grid types
LAYERS = [name for name in PLANES if name != "since"]  # an age, relative to the tile's newest sample
INTEGER = {"type": "integer"}


def _table(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


XYZ = _table(x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = _table(x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
PROPERTIES: dict[str, dict[str, Any]] = {
    LOCATION_FIX: FIX_PROPERTIES,
    TRANSFORM: {
        **dict.fromkeys(("parent_frame_id", "child_frame_id"), TEXT),
        "translation": XYZ,
        "rotation": QUATERNION,
        "speed_mps": NUMBER,
    },
    LOG: {"level": INTEGER, "line": INTEGER, **dict.fromkeys(("message", "name", "file"), TEXT)},
    GRID: {
        "frame_id": TEXT,
        "pose": _table(position=XYZ, orientation=QUATERNION),
        "cell_size": _table(x=NUMBER, y=NUMBER),
        **dict.fromkeys(("column_count", "row_stride", "cell_stride"), INTEGER),
        "fields": {"type": "array", "items": _table(name=TEXT, offset=INTEGER, type=INTEGER)},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
}


class SiteMessage(NamedTuple):
    """One message before recording. stamp_ns: when it was true."""

    topic: str
    schema: str
    stamp_ns: int
    values: Mapping[str, Any]

    def record(self, recording: Recording, log_ns: int) -> None:
        """Add it to a recording; ValueError if JSON cannot represent a value."""
        stamp_ns = self.stamp_ns or log_ns  # agents have no stamp before the first reading
        table = {"timestamp": time_of(stamp_ns), **self.values}
        data = json.dumps(plain(table), allow_nan=False).encode()
        properties = {"timestamp": TIME, **PROPERTIES[self.schema]}
        recording.write(Message(self.topic, self.schema, log_ns, stamp_ns, data), properties)


def transform_of(pose: Pose) -> SiteMessage:
    """A pose as a transform from the machine's frame, with speed."""
    half = pose.heading_rad / 2
    values = {
        "parent_frame_id": "map",
        "child_frame_id": pose.machine,
        "translation": {"x": pose.x_m, "y": pose.y_m, "z": 0.0},
        "rotation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
        "speed_mps": pose.speed_mps,
    }
    return SiteMessage(f"/machine/{pose.machine}/poses", TRANSFORM, pose.stamp_ns, values)


def place_of(pose: Pose, projection: Projection) -> SiteMessage:
    """A pose as a place on Earth, with covariance."""
    xx, xy, yy = pose.cov_xx_m2, pose.cov_xy_m2, pose.cov_yy_m2
    covariance = (xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 0.0)
    fix = fix_of(pose.machine, projection.to_geodetic(pose.x_m, pose.y_m), covariance, COVARIANCE_KNOWN)
    return SiteMessage(f"/machine/{pose.machine}/places", LOCATION_FIX, pose.stamp_ns, fix)


def health_of(health: Health) -> SiteMessage:
    """An agent's status as a log line, its health as `values`."""
    level = WARNING if problems_of(health.values) else INFO
    line = _line(level, status_of(health.values), health.machine)
    return SiteMessage(f"/machine/{health.machine}/health", LOG, health.stamp_ns, line | {"values": health.values})


def change_of(change: GroundChange) -> SiteMessage:
    """A ground change as a log line, its fields as `change`."""
    before, after = (
        "unknown" if value is None else f"{value:.3g}" for value in (change.resistance_before, change.resistance_after)
    )
    line = _line(INFO, f"the ground changed in {change.cells} cells: resistance {before} -> {after}", "map")
    return SiteMessage("/map/changes", LOG, change.last_ns, line | {"change": asdict(change)})


def gap_of(stamp_ns: int, problem: str) -> SiteMessage:
    """A gap of the recording as a log line."""
    return SiteMessage("/recording/gaps", LOG, stamp_ns, _line(WARNING, problem, "recording"))


def tile_of(tile: MapTile, cell_m: float) -> SiteMessage:
    """A tile as a grid of LAYERS, float32, NaN unknown; a topic per tile, so that all are shown."""
    planes = tile.unpacked()
    cells = np.stack([PLANES[name].values()[planes[name]] for name in LAYERS], axis=-1).astype("<f4")
    width = cells.itemsize
    corner = {"x": tile.x * TILE_CELLS * cell_m, "y": tile.y * TILE_CELLS * cell_m, "z": 0.0}
    values = {
        "frame_id": "map",
        "pose": {"position": corner, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        "cell_size": {"x": cell_m, "y": cell_m},
        "column_count": TILE_CELLS,
        "row_stride": TILE_CELLS * width * len(LAYERS),
        "cell_stride": width * len(LAYERS),
        "fields": [{"name": name, "offset": width * i, "type": FLOAT32} for i, name in enumerate(LAYERS)],
        "data": base64.b64encode(cells.tobytes()).decode(),
    }
    return SiteMessage(f"/map/tiles/{tile.x}_{tile.y}", GRID, tile.newest_ns, values)


def kind_of(topic: str) -> str:
    """Kind of a topic's messages."""
    _, first, *rest = topic.split("/")
    return rest[1] if first == "machine" else rest[0]


def _line(level: int, text: str, name: str) -> dict[str, Any]:
    return {"level": level, "message": text, "name": name, "file": "", "line": 0}
