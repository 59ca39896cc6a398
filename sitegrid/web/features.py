"""GeoJSON (RFC 7946) for GIS: areas of one kind of ground, changes, machines, roads; longitude, latitude in degrees."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from protocol.arrays import AnyArray, Floats
from protocol.queries.answers import GroundChange
from protocol.queries.map_tiles import PLANES, TILE_CELLS, TilesAnswer
from protocol.queries.roads import Line, RoadChange, RoadSegment, WorklistRow
from protocol.site.ground_classes import ZONES
from protocol.site.site_config import Projection
from protocol.wire.messages import Pose
from sitegrid.web.meridian import geometry
from sitegrid.web.values import iso

LEAST_CELLS = 4  # smaller areas of one kind are noise to the eye
Corner = tuple[float, float]


def zones(answer: TilesAnswer, boundaries: Sequence[float], projection: Projection) -> dict[str, Any]:
    """Areas of cells of the same class of resistance, as polygons with holes."""
    if not answer.tiles:
        return _collection([])
    image, column, row = _resistance(answer)
    classes = np.where(np.isnan(image), -1, np.digitize(image, boundaries))
    areas = []
    for kind in range(len(boundaries) + 1):
        for rings in _polygons(classes == kind):
            outline = [[_corner(x + column, y + row, answer.cell_m, projection) for x, y in ring] for ring in rings]
            name = ZONES[kind].name if len(boundaries) + 1 == len(ZONES) else str(kind)
            areas.append(_feature("Polygon", [[*ring, ring[0]] for ring in outline], {"class": kind, "name": name}))
    return _collection(areas)


def changes(ground_changes: Iterable[GroundChange], projection: Projection) -> dict[str, Any]:
    """Rectangles around changes of the ground."""
    out = []
    for change in ground_changes:
        west, south, east, north = change.bounds
        ring = [(west, south), (east, south), (east, north), (west, north), (west, south)]
        properties = {
            "id": change.id,
            "first_time": iso(change.first_ns),
            "last_time": iso(change.last_ns),
            "cells": change.cells,
            "resistance_before": change.resistance_before,
            "resistance_after": change.resistance_after,
        }
        out.append(_feature("Polygon", [[_corner(x, y, 1.0, projection) for x, y in ring]], properties))
    return _collection(out)


def machines(poses: Iterable[dict[str, Any]], projection: Projection) -> dict[str, Any]:
    """Points where machines are."""
    out = []
    for pose in poses:
        properties = {name: pose[name] for name in ("machine", "heading_rad", "speed_mps", "stamp_time", "age_s")}
        out.append(_feature("Point", _corner(pose["x_m"], pose["y_m"], 1.0, projection), properties))
    return _collection(out)


def tracks(tracks_of: Mapping[str, Sequence[Pose]], projection: Projection) -> dict[str, Any]:
    """Lines that machines drove."""
    out = []
    for name, poses in tracks_of.items():
        if len(poses) > 1:
            line = [_corner(pose.x_m, pose.y_m, 1.0, projection) for pose in poses]
            times = {"first_time": iso(poses[0].stamp_ns), "last_time": iso(poses[-1].stamp_ns)}
            out.append(_feature("LineString", line, {"machine": name, **times}))
    return _collection(out)


def segments(roads: Iterable[RoadSegment], projection: Projection) -> dict[str, Any]:
    """Lines of roads, in the direction that is the first of each pair."""
    return _collection([_road(one, {}, projection) for one in roads])


def worklist(rows: Iterable[WorklistRow], projection: Projection) -> dict[str, Any]:
    """Lines of the stretches where work pays; of what is lost its value, `_low` and `_high` (90 %)."""
    out = []
    for row in rows:
        lost = {"kwh_ph": row.kwh_ph, "litres_ph": row.litres_ph, "seconds_ph": row.seconds_ph}
        ends = {
            f"{name}{end}": value
            for name, three in lost.items()
            for end, value in zip(("", "_low", "_high"), three, strict=True)
        }
        since = {"since_time": iso(row.since_ns), "resistance_before": row.before, "saved_kwh_ph": row.saved_kwh_ph}
        out.append(_road(row.segment, {"rank": row.rank, **ends, **since}, projection))
    return _collection(out)


def repairs(road_changes: Iterable[RoadChange], projection: Projection) -> dict[str, Any]:
    """Lines of the stretches that were repaired or became worse, the newest first."""
    out = []
    for change in road_changes:
        properties = {
            "id": change.id,
            "first_time": iso(change.first_ns),
            "seen_time": iso(change.seen_ns),
            "resistance_before": change.before,
            "resistance_after": change.after,
            "saved_kwh_ph": change.saved_kwh_ph,
        }
        out.append(_feature("LineString", _line(change.line, projection), properties))
    return _collection(out)


def _resistance(answer: TilesAnswer) -> tuple[Floats, int, int]:
    """The whole map (rows, columns), and its first column and row."""
    xs, ys = [tile.x for tile in answer.tiles], [tile.y for tile in answer.tiles]
    left, bottom = min(xs), min(ys)
    shape = ((max(ys) - bottom + 1) * TILE_CELLS, (max(xs) - left + 1) * TILE_CELLS)
    image = np.full(shape, np.nan)
    steps = PLANES["resistance"].values()
    for tile in answer.tiles:
        row, column = (tile.y - bottom) * TILE_CELLS, (tile.x - left) * TILE_CELLS
        image[row : row + TILE_CELLS, column : column + TILE_CELLS] = steps[tile.unpacked()["resistance"]]
    return image, left * TILE_CELLS, bottom * TILE_CELLS


def _polygons(mask: AnyArray) -> Iterable[list[list[Corner]]]:
    """Areas of a mask as lists of rings along the cells' edges: the outline, then holes.

    OpenCV follows the centres of pixels; of a mask twice as fine, one pixel wider, these are the cells' edges. It cuts
    the corners of holes.
    """
    fine = np.zeros((2 * mask.shape[0] + 1, 2 * mask.shape[1] + 1), np.uint8)
    for dy in range(3):
        for dx in range(3):
            part = fine[dy : dy + 2 * mask.shape[0] : 2, dx : dx + 2 * mask.shape[1] : 2]
            part |= mask.astype(np.uint8)
    contours, order = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    for index, contour in enumerate(contours):
        if order[0][index][3] >= 0 or cv2.contourArea(contour) < 4 * LEAST_CELLS:
            continue
        rings, hole = [contour], order[0][index][2]
        while hole >= 0:
            rings.append(contours[hole])
            hole = order[0][hole][0]
        yield [[(float(x) / 2, float(y) / 2) for x, y in ring[:, 0].tolist()] for ring in rings if len(ring) >= 3]


def _road(road: RoadSegment, more: dict[str, Any], projection: Projection) -> dict[str, Any]:
    """A stretch as a line. Pairs become two properties, since few programs read lists."""
    properties = {name: value for name, value in asdict(road).items() if name not in ("line", "passes_ph", "tonnes_ph")}
    for name, (there, back) in (("passes_ph", road.passes_ph), ("tonnes_ph", road.tonnes_ph)):
        properties |= {name: there, f"{name}_back": back}
    return _feature("LineString", _line(road.line, projection), {**more, **properties})


def _line(line: Line, projection: Projection) -> list[list[float]]:
    return [_corner(x, y, 1.0, projection) for x, y in line]


def _corner(x: float, y: float, scale: float, projection: Projection) -> list[float]:
    lat_deg, lon_deg, _ = projection.to_geodetic(x * scale, y * scale)
    return [round(lon_deg, 8), round(lat_deg, 8)]


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry(kind, coordinates), "properties": properties}


def _collection(features: list[dict[str, Any]]) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": features}
