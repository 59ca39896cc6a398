"""XYZ tiles with pixels larger than cells: the mean of known cells under each pixel.

The map is read in driven parts, so a tile costs what is known below it, not its area.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator

import numpy as np

from protocol.arrays import Floats
from protocol.queries.map_tiles import TILE_CELLS
from protocol.queries.requests import MAX_RESOLUTION_M, WITHOUT_MEAN
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection
from sitegrid.client import Client
from sitegrid.web.xyz import mercator
from sitegrid.web.xyz.mercator import SIDE_PX

LEAST_CELLS = 3.0  # pixel edge in cells; below, a pixel shows the cell at its centre
FILL = 1.5  # pixel edge over its coarse cells' edge: every pixel gets one at any rotation
PART_TILES = 16  # map tiles per side of a part: a million cells per query
ROWS_AT_ONCE = 64  # of a part, turned into pixels: 10 MB; all would take 150
PART_CELLS = PART_TILES * TILE_CELLS
Place = tuple[int, int, int]  # zoom, column and row of an XYZ tile


def draw(
    client: Client, tiles: Iterable[tuple[int, int]], layer: str, place: Place, cell_m: float, projection: Projection
) -> Floats:
    """Values (256, 256) of an XYZ tile, NaN unknown. tiles: map tiles with any ground."""
    pixel_m = mercator.pixel_m(place[0], projection.to_geodetic(0.0, 0.0)[0])
    most_m = min(pixel_m / FILL, MAX_RESOLUTION_M, PART_CELLS * cell_m)
    edge_m = cell_m * 2 ** max(0, math.floor(math.log2(most_m / cell_m)))
    resolution_m = None if layer in WITHOUT_MEAN else edge_m
    total, count = np.zeros((2, SIDE_PX * SIDE_PX))
    for bounds in _parts_in(tiles, place, pixel_m, cell_m, projection):
        region = client.region(bounds, (layer,), resolution_m=resolution_m)
        for first in range(0, len(region.y_m), ROWS_AT_ONCE):
            values = region[layer][first : first + ROWS_AT_ONCE]
            rows, columns = np.nonzero(np.isfinite(values))
            column, row = _pixels(region.x_m[columns], region.y_m[first + rows], place, projection)
            inside = (column >= 0) & (column < SIDE_PX) & (row >= 0) & (row < SIDE_PX)
            pixel, known = (row * SIDE_PX + column)[inside], values[rows, columns][inside]
            if resolution_m is None:  # classes and directions: any one
                total[pixel], count[pixel] = known, 1
            else:
                total += np.bincount(pixel, known, len(total))
                count += np.bincount(pixel, minlength=len(count))
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count).reshape(SIDE_PX, SIDE_PX)


def _parts_in(
    tiles: Iterable[tuple[int, int]], place: Place, pixel_m: float, cell_m: float, projection: Projection
) -> Iterator[Bounds]:
    """Driven parts that may overlap an XYZ tile."""
    edge_m, n = TILE_CELLS * cell_m, 2 ** place[0] * SIDE_PX
    parts = defaultdict[tuple[int, int], list[tuple[int, int]]](list)
    for x, y in tiles:
        parts[x // PART_TILES, y // PART_TILES].append((x, y))
    for part in sorted(parts):
        (west_m, south_m), (east_m, north_m) = (end(parts[part], axis=0) * edge_m for end in (np.min, np.max))
        bounds = Bounds(float(west_m), float(south_m), float(east_m + edge_m), float(north_m + edge_m))
        middle = np.array([[west_m + east_m], [south_m + north_m]]) / 2 + edge_m / 2
        column, row = _pixels(middle[0], middle[1], place, projection)
        reach_px = SIDE_PX / 2 + PART_CELLS * cell_m / pixel_m  # centre of the tile to centre of a part
        east_px = (float(column[0]) - SIDE_PX / 2 + n / 2) % n - n / 2
        if abs(east_px) <= reach_px and abs(float(row[0]) - SIDE_PX / 2) <= reach_px:
            yield bounds


def _pixels(x_m: Floats, y_m: Floats, place: Place, projection: Projection) -> tuple[Floats, Floats]:
    """Columns and rows of pixels of an XYZ tile, whole numbers, from places in `map`; columns go on round the Earth."""
    lat_deg, lon_deg, _ = projection.to_geodetic_many(x_m, y_m, np.zeros(len(x_m)))
    z, x, y = place
    column, row = mercator.tiles_at(lat_deg, lon_deg, z)
    return np.floor((column - x) % 2**z * SIDE_PX).astype(np.int64), np.floor((row - y) * SIDE_PX).astype(np.int64)
