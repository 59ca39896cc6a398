"""Feature kinds of a site: changes, machines, tracks, roads and road work. Ground: `zones.py`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.wire.messages import Pose
from sitegrid.features.feature import Collection, FeatureKind, Time


def _line(item: Any) -> list[Floats]:
    return [np.array(item.line, np.float64)]


def _rectangle(item: Any) -> list[Floats]:
    west, south, east, north = item.bounds
    return [np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])]


def _floats(*names: str) -> dict[str, tuple[type, str]]:
    return {name: (float, name) for name in names}


# From `Fuel`, if known.
FUEL = {
    "burned_litres_ph": (float, "fuel.burned_ph.0"),
    "predicted_litres_ph": (float, "fuel.predicted_ph.0"),
    "burned_share": (float, "fuel.share"),
}

# From `GroundChange`: rectangles.
CHANGE = FeatureKind(
    "Polygon",
    _rectangle,
    {
        "id": (int, "id"),
        "first_time": (Time, "first_ns"),
        "last_time": (Time, "last_ns"),
        "cells": (int, "cells"),
        **_floats("resistance_before", "resistance_after"),
    },
)
# From poses as tables.
MACHINE = FeatureKind(
    "Point",
    lambda pose: [np.array([(pose["x_m"], pose["y_m"])])],
    {
        "machine": (str, "machine"),
        **_floats("heading_rad", "speed_mps"),
        "stamp_time": (Time, "stamp_ns"),
        **_floats("age_s"),
    },
)
# From tables: machine, line (n, 2), first_ns, last_ns.
TRACK = FeatureKind(
    "LineString",
    lambda track: [track["line"]],
    {"machine": (str, "machine"), "first_time": (Time, "first_ns"), "last_time": (Time, "last_ns")},
)
# From `RoadSegment`; pairs by direction, the first along the line, become two fields, because few programs read lists.
SEGMENT = FeatureKind(
    "LineString",
    _line,
    {
        "id": (str, "id"),
        **_floats("length_m", "resistance", "resistance_std", "grade", "trend", "unmeasured"),
        "guessed": (bool, "guessed"),
        "machines": (int, "machines"),
        **{
            f"{name}{end}": (float, f"{name}.{index}")
            for name in ("passes_ph", "tonnes_ph")
            for index, end in enumerate(("", "_back"))
        },
        **FUEL,
    },
)
# From `WorklistRow`; losses as value, `_low` and `_high` (90 %).
WORK = FeatureKind(
    "LineString",
    lambda row: _line(row.segment),
    {
        "rank": (int, "rank"),
        **{
            f"{name}{end}": (float, f"{name}.{index}")
            for name in ("kwh_ph", "litres_ph", "seconds_ph")
            for index, end in enumerate(("", "_low", "_high"))
        },
        "since_time": (Time, "since_ns"),
        "resistance_before": (float, "before"),
        "saved_kwh_ph": (float, "saved_kwh_ph"),
        **{name: (field_type, f"segment.{path}") for name, (field_type, path) in SEGMENT.fields.items()},
    },
)
# From `RoadChange`: better or worse.
REPAIR = FeatureKind(
    "LineString",
    _line,
    {
        "id": (str, "id"),
        "first_time": (Time, "first_ns"),
        "seen_time": (Time, "seen_ns"),
        "resistance_before": (float, "before"),
        "resistance_after": (float, "after"),
        "saved_kwh_ph": (float, "saved_kwh_ph"),
        **FUEL,
    },
)


def tracks(tracks_of: Mapping[str, Sequence[Pose]]) -> Collection:
    """Driven lines, lazily."""
    return Collection(TRACK, _tracks(tracks_of))


def _tracks(tracks_of: Mapping[str, Sequence[Pose]]) -> Iterator[dict[str, Any]]:
    for name, poses in tracks_of.items():
        if len(poses) > 1:
            line = np.array([(pose.x_m, pose.y_m) for pose in poses])
            yield {"machine": name, "line": line, "first_ns": poses[0].stamp_ns, "last_ns": poses[-1].stamp_ns}
