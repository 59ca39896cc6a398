"""Ground areas from map tiles: polygons with holes along cell edges."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Any

import cv2
import numpy as np

from protocol.arrays import AnyArray, Floats, Ints
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, TilesAnswer
from protocol.site.geometry import Bounds, GridGeometry
from protocol.site.ground_classes import ZONES
from sitegrid.features.feature import Collection, FeatureKind

ZONE = FeatureKind("Polygon", lambda zone: zone["lines"], {"class": (int, "class"), "name": (str, "name")})
LEAST_CELLS = 4  # smaller areas look like noise
# Tiles per side of a picture: 17 MB. Wider areas (2 km) are cut.
MOST_TILES = 32
UNKNOWN = 255  # class of unknown cells


def zones(answer: TilesAnswer, boundaries: Sequence[float], within: Bounds | None = None) -> Collection:
    """Areas of one resistance class, lazily. within: only these cells."""
    classes = np.digitize(PLANES["resistance"].values(), boundaries).astype(np.uint8)
    classes[0] = UNKNOWN
    return Collection(ZONE, _zones(answer, classes, len(boundaries) + 1, within))


def _zones(answer: TilesAnswer, classes: AnyArray, count: int, within: Bounds | None) -> Iterator[dict[str, Any]]:
    for tiles in _pictures(answer.tiles):
        image, corner = _classes(tiles, classes)
        if within:
            image = _cut(image, corner, GridGeometry(answer.cell_m), within)
        for kind in range(count):
            name = ZONES[kind].name if count == len(ZONES) else str(kind)
            for rings in _polygons(image == kind):
                lines = [_closed(ring + corner) * answer.cell_m for ring in rings]
                yield {"lines": lines, "class": kind, "name": name}


def _cut(image: AnyArray, corner: Ints, geometry: GridGeometry, within: Bounds) -> AnyArray:
    """Classes of the cells that a rectangle touches; others unknown."""
    window = geometry.window(within)
    first = np.array([window.row, window.column]) - corner[::-1]
    rows, columns = (
        slice(max(0, begin), max(0, begin + count))
        for begin, count in zip(first.tolist(), (window.rows, window.columns), strict=True)
    )
    out = np.full_like(image, UNKNOWN)
    out[rows, columns] = image[rows, columns]
    return out


def _closed(ring: Floats) -> Floats:
    return np.concatenate([ring, ring[:1]])


def _pictures(tiles: Iterable[MapTile]) -> Iterator[list[MapTile]]:
    """Groups of touching tiles, at most MOST_TILES a side, so that distant areas do not share a picture."""
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
    """Areas of a mask as rings (n, 2) along cell edges: outline, then holes.

    OpenCV follows pixel centres; in a mask of twice the resolution, one pixel wider, these are cell edges. It cuts the
    corners of holes.
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
