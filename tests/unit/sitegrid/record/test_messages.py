"""Foxglove shows what the site said: places, transforms, grids; JSON limits are refused."""

from __future__ import annotations

import base64
import json
import math
import threading
import zlib
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from protocol.queries.answers import GroundChange
from protocol.queries.map_tiles import AREA, PLANES, TILE_CELLS, MapTile
from protocol.recording import RecordedFile, Recording
from protocol.site.site_config import Projection, SiteConfig
from protocol.wire.messages import Health, Pose
from sitegrid.record.messages import (
    LAYERS,
    PROPERTIES,
    WARNING,
    SiteMessage,
    change_of,
    health_of,
    place_of,
    tile_of,
    transform_of,
)
from sitegrid.record.recorder import Waiting

SITE = SiteConfig("paper", 49.01, 8.4)
POSE = Pose("loader-1", 1_700_000_000_123_456_789, 120.5, -30.25, 2.5, 3.5, 0.04, 0.01, 0.09)


def recorded(path: Path, said: SiteMessage) -> dict:
    """The message as read back, valid by its schema."""
    recording = Recording(path, {})
    said.record(recording, 1)
    recording.finish()
    (message,) = RecordedFile(path).messages()
    assert (message.topic, message.stamp_ns) == (said.topic, said.stamp_ns or 1)
    table = json.loads(message.data)
    jsonschema.validate(table, {"properties": PROPERTIES[said.schema], "required": [*PROPERTIES[said.schema]]})
    return table


def test_a_pose_is_a_transform_and_a_place_on_earth(tmp_path: Path):
    turned = recorded(tmp_path / "a.mcap", transform_of(POSE))
    assert turned["timestamp"] == {"sec": 1_700_000_000, "nsec": 123_456_789}
    assert (turned["translation"]["x"], turned["translation"]["y"], turned["speed_mps"]) == (120.5, -30.25, 3.5)
    assert 2 * math.atan2(turned["rotation"]["z"], turned["rotation"]["w"]) == pytest.approx(POSE.heading_rad)
    fix = recorded(tmp_path / "b.mcap", place_of(POSE, Projection(SITE)))
    place = Projection(SITE).to_map(fix["latitude"], fix["longitude"], fix["altitude"])
    assert place == pytest.approx((POSE.x_m, POSE.y_m, 0.0), abs=1e-6)
    assert fix["position_covariance"] == [0.04, 0.01, 0, 0.01, 0.09, 0, 0, 0, 0]


def test_a_tile_is_a_grid_whose_cells_lie_where_they_are(tmp_path: Path):
    planes = np.random.default_rng(3).integers(0, 256, (len(PLANES), TILE_CELLS, TILE_CELLS), np.uint8)
    tile = MapTile(-2, 3, 1, 1, POSE.stamp_ns, zlib.compress(planes.tobytes()))
    grid = recorded(tmp_path / "a.mcap", tile_of(tile, 0.5))
    assert (grid["pose"]["position"]["x"], grid["pose"]["position"]["y"]) == (-64.0, 96.0)
    data = base64.b64decode(grid["data"])
    assert len(data) == 4 * AREA * len(LAYERS) == grid["row_stride"] * TILE_CELLS
    for field in grid["fields"]:
        row, column = 5, 17
        at = row * grid["row_stride"] + column * grid["cell_stride"] + field["offset"]
        value = np.frombuffer(data[at : at + 4], "<f4")[0]
        expected = PLANES[field["name"]].values()[planes[[*PLANES].index(field["name"]), row, column]]
        assert value == pytest.approx(expected, nan_ok=True)


def test_health_and_changes_are_lines_of_a_log(tmp_path: Path):
    health = Health(
        "loader-1", 0, {"status": "no GPS fixes", "problems": ["no GPS fixes"], "pipeline": {"std": math.nan}}
    )
    line = recorded(tmp_path / "a.mcap", health_of(health))
    assert (line["level"], line["message"], line["values"]["pipeline"]) == (WARNING, "no GPS fixes", {"std": None})
    change = GroundChange(4, 5, 6, (0.0, 1.0, 2.0, 3.0), 34, None, 0.0612, None, None)
    line = recorded(tmp_path / "b.mcap", change_of(change))
    assert line["message"] == "the ground changed in 34 cells: resistance unknown -> 0.0612"
    assert line["change"]["bounds"] == [0.0, 1.0, 2.0, 3.0]


def test_what_json_does_not_know_is_refused(tmp_path: Path):
    recording = Recording(tmp_path / "a.mcap", {})
    with pytest.raises(ValueError, match="not JSON compliant"):
        health_of(Health("loader-1", 1, {"far": math.inf})).record(recording, 1)
    recording.abandon()


def test_what_waits_is_bounded_and_makes_room_as_it_is_done():
    waiting, done = Waiting(100), list[int]()
    assert all(waiting.put(lambda i=i: done.append(i), 40) for i in range(2))
    assert not waiting.put(lambda: done.append(2), 40)
    patient = threading.Thread(target=lambda: waiting.put(lambda: done.append(3), 40, 60.0))
    patient.start()
    waiting.do_next(0.0)
    patient.join()
    for _ in range(3):
        waiting.do_next(0.0)
    assert done == [0, 1, 3]
