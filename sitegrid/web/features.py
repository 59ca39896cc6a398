"""GeoJSON (RFC 7946) for GIS: areas of one kind of ground, changes, machines, roads; longitude, latitude in degrees."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import product
from typing import Any

import cv2
import numpy as np

from protocol.arrays import AnyArray, Floats, Ints
from protocol.queries.answers import GroundChange
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, TilesAnswer
from protocol.queries.roads import Corners, RoadChange, RoadSegment, WorklistRow
from protocol.site.ground_classes import ZONES
from protocol.site.site_config import Projection
from protocol.wire.messages import Pose
from sitegrid.web.meridian import geometry
from sitegrid.web.values import iso

LEAST_CELLS = 4  # smaller areas of one kind are noise to the eye
# A picture's side: 17 MB while its areas are followed. An area that is wider than 2 km is cut there.
MOST_TILES = 32
UNKNOWN = 255  # in place of a class


def zones(answer: TilesAnswer, boundaries: Sequence[float], projection: Projection) -> dict[str, Any]:
    """Areas of cells of the same class of resistance, as polygons with holes; made as they are iterated over."""
    classes = np.digitize(PLANES["resistance"].values(), boundaries).astype(np.uint8)
    classes[0] = UNKNOWN
    return {"type": "FeatureCollection", "features": _zones(answer, classes, len(boundaries) + 1, projection)}


def _zones(answer: TilesAnswer, classes: AnyArray, count: int, projection: Projection) -> Iterator[dict[str, Any]]:
    for tiles in _pictures(answer.tiles):
        image, corner = _classes(tiles, classes)
        for kind in range(count):
            name = ZONES[kind].name if count == len(ZONES) else str(kind)
            for rings in _polygons(image == kind):
                outline = [_ring((ring + corner) * answer.cell_m, projection) for ring in rings]
                yield _feature("Polygon", outline, {"class": kind, "name": name})


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


def _pictures(tiles: Iterable[MapTile]) -> Iterator[list[MapTile]]:
    """Tiles that touch, MOST_TILES to a side at most: what lies far away costs its own picture alone."""
    left = {(tile.x, tile.y): tile for tile in tiles}
    while left:
        group, edge = dict[tuple[int, int], MapTile](), [next(iter(left))]
        while edge:
            x, y = place = edge.pop()
            if place in left:
                group[place] = left.pop(place)
                edge += [(x + right, y + up) for right, up in product((-1, 0, 1), repeat=2)]
        west, south = (min(place[axis] for place in group) for axis in (0, 1))
        parts = defaultdict[tuple[int, int], list[MapTile]](list)
        for (x, y), tile in group.items():
            parts[(x - west) // MOST_TILES, (y - south) // MOST_TILES].append(tile)
        yield from parts.values()


def _classes(tiles: Sequence[MapTile], classes: AnyArray) -> tuple[AnyArray, Ints]:
    """Classes of a picture's cells (rows, columns), and its first column and row."""
    first, last = (end([(tile.x, tile.y) for tile in tiles], axis=0) for end in (np.min, np.max))
    columns, rows = (last - first + 1) * TILE_CELLS
    image = np.full((rows, columns), UNKNOWN, np.uint8)
    for tile in tiles:
        column, row = (np.array([tile.x, tile.y]) - first) * TILE_CELLS
        image[row : row + TILE_CELLS, column : column + TILE_CELLS] = classes[tile.unpacked()["resistance"]]
    return image, first * TILE_CELLS


def _polygons(mask: AnyArray) -> Iterator[list[Floats]]:
    """Areas of a mask as lists of rings (n, 2) along the cells' edges: the outline, then holes.

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
        yield [ring[:, 0] / 2 for ring in rings if len(ring) >= 3]


def _road(road: RoadSegment, more: dict[str, Any], projection: Projection) -> dict[str, Any]:
    """A stretch as a line. Pairs become two properties, since few programs read lists."""
    properties = {name: value for name, value in asdict(road).items() if name not in ("line", "passes_ph", "tonnes_ph")}
    for name, (there, back) in (("passes_ph", road.passes_ph), ("tonnes_ph", road.tonnes_ph)):
        properties |= {name: there, f"{name}_back": back}
    return _feature("LineString", _line(road.line, projection), {**more, **properties})


def _line(line: Corners, projection: Projection) -> list[list[float]]:
    return [_corner(x, y, 1.0, projection) for x, y in line]


def _corner(x: float, y: float, scale: float, projection: Projection) -> list[float]:
    lat_deg, lon_deg, _ = projection.to_geodetic(x * scale, y * scale)
    return [round(lon_deg, 8), round(lat_deg, 8)]


def _ring(corners_m: Floats, projection: Projection) -> Floats:
    """A closed ring (n + 1, 2) of longitudes and latitudes."""
    x_m, y_m = np.concatenate([corners_m, corners_m[:1]]).T
    lat_deg, lon_deg, _ = projection.to_geodetic_many(x_m, y_m, np.zeros(len(x_m)))
    return np.stack([lon_deg, lat_deg], axis=1).round(8)


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry(kind, coordinates), "properties": properties}


def _collection(features: list[dict[str, Any]]) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": features}
