"""XYZ tiles in Web Mercator: cells under a tile's pixels, and the PNG."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from protocol.arrays import AnyArray, Floats, Floats32
from protocol.site.geometry import Bounds
from protocol.site.ground_classes import ZONES
from protocol.site.site_config import Projection

SIDE_PX = 256
MAX_ZOOM = 24
RADIUS_M = 6378137.0  # Web Mercator's sphere
# 24-bit values in RGB: value = offset + scale (65536 r + 256 g + b); 0: unknown.
COARSE = dict.fromkeys(("age_s", "changed_s"), (1.0, -1.0)) | dict.fromkeys(
    ("visits", "machines", "weight"), (1e-3, -1e-3)
)
FINE = (1e-6, -4.0)  # single precision over the range of slopes and angles
MOST = 2**24 - 1


@dataclass(frozen=True)
class Pixels:
    """Pixel centres of a tile in `map` [m], both (256, 256), row 0 in the north.

    Infinite on the far side of the Earth, beyond the site's projection.
    """

    x_m: Floats
    y_m: Floats

    def bounds(self, known: Bounds, cell_m: float) -> Bounds | None:
        """Bounds of pixels inside `known`, one cell wider; None if there are none."""
        x, y = self.x_m, self.y_m
        inside = (x >= known.west_m) & (x < known.east_m) & (y >= known.south_m) & (y < known.north_m)
        if not inside.any():
            return None
        (west, south), (east, north) = ((end(x[inside]), end(y[inside])) for end in (np.min, np.max))
        return Bounds(float(west) - cell_m, float(south) - cell_m, float(east) + cell_m, float(north) + cell_m)

    def sample(self, layer: Floats32, first_x_m: float, first_y_m: float, cell_m: float) -> Floats:
        """Cell value per pixel (256, 256), NaN outside; first_x_m, first_y_m: the layer's outer corner."""
        column, row = np.floor((self.x_m - first_x_m) / cell_m), np.floor((self.y_m - first_y_m) / cell_m)
        inside = (column >= 0) & (row >= 0) & (column < layer.shape[1]) & (row < layer.shape[0])
        out = np.full(column.shape, np.nan)
        out[inside] = layer[row[inside].astype(np.int64), column[inside].astype(np.int64)]
        return out


def pixels_of(z: int, x: int, y: int, projection: Projection) -> Pixels:
    """Pixel centres of a tile."""
    centres = (np.arange(SIDE_PX) + 0.5) / SIDE_PX
    u, v = np.meshgrid((x + centres) / 2**z, (y + centres) / 2**z)
    return Pixels(*projection.to_map_many(*places_at(u, v)))


def places_at(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Latitudes, longitudes [deg] of places on the world's tile, 0 to 1 from the west and from the north."""
    return np.degrees(np.arctan(np.sinh(math.pi * (1 - 2 * v)))), u * 360.0 - 180.0


def tiles_at(lat_deg: Floats, lon_deg: Floats, z: int) -> tuple[Floats, Floats]:
    """Fractional tile columns and rows of places."""
    row = (1 - np.arcsinh(np.tan(np.radians(lat_deg))) / math.pi) / 2 * 2**z
    return (lon_deg + 180.0) / 360.0 * 2**z, row


def pixel_m(z: int, lat_deg: float) -> float:
    """Pixel edge on the ground [m]."""
    return float(2 * math.pi * RADIUS_M * math.cos(math.radians(lat_deg)) / (2**z * SIDE_PX))


def tile_at(lat_deg: float, lon_deg: float, z: int) -> tuple[int, int]:
    """Column and row of a place's tile."""
    column, row = tiles_at(np.array(lat_deg), np.array(lon_deg), z)
    return int(column), int(row)


def coding(layer: str) -> tuple[float, float]:
    """Scale and offset of a layer's 24-bit values."""
    return COARSE.get(layer, FINE)


def value_png(values: Floats, layer: str) -> bytes:
    """Values (256, 256) in 24 bits, clipped."""
    known = ~np.isnan(values)
    scale, offset = coding(layer)
    steps = np.clip(np.rint((np.where(known, values, 0) - offset) / scale), 1, MOST)
    steps = np.where(known, steps, 0).astype(np.int64)
    return _png(np.stack([steps & 255, steps >> 8 & 255, steps >> 16 & 255], axis=-1).astype(np.uint8))


def colour_png(values: Floats, layer: str) -> bytes:
    """Values (256, 256) in the layer's colours; transparent if unknown."""
    known = ~np.isnan(values)
    colours = _colours(np.where(known, values, 0.0), layer)
    alpha = np.where(known, 255, 0)[..., None]
    return _png(np.concatenate([colours, alpha], axis=-1).astype(np.uint8))


def empty_png(kind: str) -> bytes:
    """A tile without known cells."""
    return EMPTY_VALUES if kind == "value" else EMPTY_COLOURS


# Ends of palettes, default those of a share. Ages and counts are shown logarithmically.
ENDS = {"grade": (0.0, 0.3), "grade_std": (0.0, 0.2), "grade_east": (-0.3, 0.3), "grade_north": (-0.3, 0.3)}
LOGARITHMIC = {"resistance": (0.006, 0.3), "visits": (1.0, 60.0), "age_s": (10.0, 86400.0), "weight": (0.1, 1000.0)}
LOGARITHMIC |= {"resistance_std": (0.0005, 0.1), "changed_s": (10.0, 86400.0), "machines": (1.0, 60.0)}
# Dark blue to yellow: the page's ordered palette, evenly spaced in OKLab; BGR.
ORDERED = np.array(
    [(119, 55, 36), (127, 71, 51), (140, 108, 90), (141, 139, 130), (131, 154, 155), (120, 190, 186), (92, 221, 251)]
)


def _colours(values: Floats, layer: str) -> AnyArray:
    if layer == "resistance_class":
        table = np.array([zone.bgr for zone in ZONES])
        return np.asarray(table[np.clip(values.astype(np.int64), 0, len(table) - 1)])
    if layer in LOGARITHMIC:
        low, high = LOGARITHMIC[layer]
        part = np.log(np.maximum(values, low) / low) / math.log(high / low)
    else:
        low, high = ENDS.get(layer, (0.0, 1.0))
        part = (values - low) / (high - low)
    place = np.clip(part, 0, 1) * (len(ORDERED) - 1)
    axis = np.arange(len(ORDERED))
    return np.stack([np.interp(place, axis, ORDERED[:, channel]) for channel in range(3)], axis=-1)


def _png(image: AnyArray) -> bytes:
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes())


EMPTY_VALUES, EMPTY_COLOURS = (_png(np.zeros((SIDE_PX, SIDE_PX, bands), np.uint8)) for bands in (3, 4))
