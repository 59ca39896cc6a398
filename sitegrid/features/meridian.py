"""GeoJSON cut at the 180th meridian (RFC 7946, 3.1.9); else programs draw it around the Earth.

Places are longitude and latitude [deg]; internally longitudes run from 0 to 360.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from protocol.arrays import Floats

MERIDIAN = 180.0


def geometry(kind: str, coordinates: Any) -> dict[str, Any]:
    """A geometry, multi-part if cut. kind: Point, LineString or Polygon with closed rings."""
    lines = [np.array(line, np.float64) for line in (coordinates if kind == "Polygon" else [coordinates])]
    if kind == "Point" or not any(np.ptp(line[:, 0]) > MERIDIAN for line in lines):
        return {"type": kind, "coordinates": coordinates}
    for line in lines:
        line[:, 0] %= 2 * MERIDIAN
    if kind == "LineString":
        return {"type": "MultiLineString", "coordinates": [_on_earth(part) for part in _cut(lines[0])]}
    areas = [[_on_earth(ring) for ring in area] for is_west in (True, False) for area in _areas(lines, is_west=is_west)]
    return {"type": "MultiPolygon", "coordinates": areas}


def _on_earth(line: Floats) -> list[list[float]]:
    east = 2 * MERIDIAN if line[:, 0].max() > MERIDIAN else 0.0
    return [[lon, lat] for lon, lat in (line - (east, 0.0)).round(8).tolist()]


def _cut(line: Floats) -> list[Floats]:
    """Parts of a line (n, 2), each on one side, up to the meridian."""
    lon, lat = line.T
    after = np.flatnonzero(np.diff(lon < MERIDIAN)) + 1
    share = (MERIDIAN - lon[after - 1]) / (lon[after] - lon[after - 1])
    on = np.stack([np.full(len(after), MERIDIAN), lat[after - 1] + share * (lat[after] - lat[after - 1])], axis=1)
    parts = enumerate(np.split(line, after))
    return [np.concatenate([on[max(0, i - 1) : i], part, on[i : i + 1]]) for i, part in parts]


def _cut_ring(ring: Floats) -> list[Floats]:
    """Parts of a closed ring, from meridian to meridian; an uncut ring as it is."""
    begins = np.flatnonzero(np.diff(ring[:, 0] < MERIDIAN)) + 1
    if not len(begins):
        return [ring]
    first, *parts, last = _cut(np.concatenate([ring[begins[0] : -1], ring[: begins[0] + 1]]))
    return [np.concatenate([last[:1], first]), *parts]


def _areas(rings: Sequence[Floats], *, is_west: bool) -> list[list[Floats]]:
    """A polygon's parts on one side: outline, then holes."""
    pieces = [piece for piece in chain(*map(_cut_ring, rings)) if (piece[1:-1, 0].mean() < MERIDIAN) == is_west]
    parts = [piece for piece in pieces if (piece[[0, -1], 0] == MERIDIAN).all()]
    areas = [[outline] for outline in _joined(parts)]
    for hole in (piece for piece in pieces if not (piece[[0, -1], 0] == MERIDIAN).all()):
        next(area for area in areas if len(areas) == 1 or _holds(area[0], hole[0])).append(hole)
    return areas


def _joined(parts: Sequence[Floats]) -> list[Floats]:
    """Close parts along the meridian: from south to north every second interval is inside."""
    ends = np.argsort([part[end, 1] for part in parts for end in (0, -1)], kind="stable").tolist()
    across = dict(zip(ends, chain(*((b, a) for a, b in zip(ends[::2], ends[1::2], strict=True))), strict=True))
    rings, left = [], set(range(len(parts)))
    while left:
        first = left.pop()
        ring, at = [parts[first]], across[2 * first + 1]
        while at != 2 * first:
            number, is_last = divmod(at, 2)
            left.remove(number)
            ring.append(parts[number][::-1] if is_last else parts[number])
            at = across[2 * number + 1 - is_last]
        rings.append(np.concatenate([*ring, ring[0][:1]]))
    return rings


def _holds(ring: Floats, place: Floats) -> bool:
    """Whether a place is in a ring: an odd number of sides lies to its west."""
    (lon, lat), (to_lon, to_lat) = ring[:-1].T, ring[1:].T
    crosses = (lat > place[1]) != (to_lat > place[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        west = lon + (place[1] - lat) / (to_lat - lat) * (to_lon - lon) < place[0]
    return bool((crosses & west).sum() % 2)
