"""What the page draws beneath a site's map: the site's outline, and a base map of the operator's own."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from protocol.arrays import Floats
from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.queries.answers import SiteInfo
from protocol.site.site_config import MAX_EXTENT_M, Projection, SiteConfig
from sitegrid.web.values import RequestProblem
from sitegrid.web.xyz.mercator import MAX_ZOOM, RADIUS_M, places_at, tiles_at

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
MAX_CORNERS = 10_000  # of an outline, which is drawn sixty times a second while machines drive
# Addresses stand in the content policy, where `;`, `,` and spaces end a part.
TILES = re.compile(r"https?://[\w.:\[\]-]+/(?:[^\s;,'\"{}]|\{[zxy]\})*")
FITTED = 9  # places along each axis of a fit


@dataclass(frozen=True)
class BackdropConfig:
    """A site's table of the page's configuration.

    outline: GeoJSON file. base_map: picture, or address of XYZ tiles with {z}, {x}, {y}. bounds: of a picture, west,
    south, east, north. max_zoom: deepest tiles of the server. units: of outline and bounds, "degrees" (longitude,
    latitude) or "metres" of the site.
    """

    outline: str = ""
    base_map: str = ""
    bounds: tuple[float, float, float, float] | None = None
    max_zoom: int = 19
    attribution: str = ""
    units: str = "degrees"

    def __post_init__(self) -> None:
        if self.units not in ("degrees", "metres"):
            raise ValueError(f'units: {self.units!r} is neither "degrees" nor "metres"')
        if not 0 <= self.max_zoom <= MAX_ZOOM:
            raise ValueError(f"max_zoom: {self.max_zoom} is not between 0 and {MAX_ZOOM}")
        if self.has_tiles:
            if not (TILES.fullmatch(self.base_map) and all(f"{{{axis}}}" in self.base_map for axis in "zxy")):
                raise ValueError(f"base_map: {self.base_map!r} is no http address with {{z}}, {{x}}, {{y}} and no more")
        elif self.base_map:
            if not self.base_map.lower().endswith(PICTURES):
                raise ValueError(f"base_map: {self.base_map!r} is neither an address nor a file {', '.join(PICTURES)}")
            if not self.bounds or self.bounds[0] >= self.bounds[2] or self.bounds[1] >= self.bounds[3]:
                raise ValueError("bounds: a picture needs [west, south, east, north]")

    @property
    def has_tiles(self) -> bool:
        """Whether the base map is an address of tiles."""
        return "://" in self.base_map


@dataclass(frozen=True)
class Backdrop:
    """A site's outline and base map. rings: (n, 2) in its units. picture: file of the base map."""

    config: BackdropConfig
    rings: tuple[Floats, ...] = ()
    picture: Path | None = None

    @property
    def source(self) -> str:
        """What pages may load tiles from, for the content policy: the folder before the first placeholder."""
        if not self.config.has_tiles:
            return ""
        scheme, place, path, *_ = urlsplit(self.config.base_map)
        return f"{scheme}://{place}{path[: path.rindex('/', 0, path.index('{')) + 1] if '{' in path else path}"

    def described(self, site: SiteConfig | SiteInfo, projection: Projection, picture: str) -> dict[str, Any]:
        """For the page, in metres of the site. picture: address of the base map's."""
        base_map: dict[str, Any] | None = None
        if self.config.has_tiles:
            fit = _mercator(site, projection)
            base_map = {"tiles": self.config.base_map, "max_zoom": self.config.max_zoom, **fit}
        elif self.config.bounds and self.picture:
            west, south, east, north = self.config.bounds
            corners = np.array([(west, north), (east, north), (west, south)])
            base_map = {"picture": picture, "corners": self._in_metres("bounds", corners, projection)}
        rings = [self._in_metres("outline", ring, projection) for ring in self.rings]
        return {"outline": rings, "base_map": base_map, "attribution": self.config.attribution}

    def _in_metres(self, name: str, places: Floats, projection: Projection) -> list[list[float]]:
        x, y = places.T if self.config.units == "metres" else projection.to_map_many(places[:, 1], places[:, 0])
        metres = np.stack([x, y], axis=1)
        if not (np.abs(metres) <= MAX_EXTENT_M).all():
            detail = f"`{name}` of the page's configuration is {MAX_EXTENT_M / 1000:g} km off the site; see `units`"
            raise RequestProblem(HTTPStatus.CONFLICT, "elsewhere", detail)
        return metres.round(3).tolist()  # type: ignore[no-any-return]


def _mercator(site: SiteConfig | SiteInfo, projection: Projection) -> dict[str, Any]:
    """Web Mercator to the site's frame, by least squares over the site.

    With (u, v) a place on the world's tile, p = metres (u - origin[0]) and q = metres (origin[1] - v):
    (x, y) = fit @ (1, p, q, p^2, p q, q^2). 20 km from the origin it is off by 0.02 m at 49
    degrees of latitude, by 0.33 m at 70 (tests/unit/sitegrid/web/test_backdrop.py).
    """
    lat, lon = (np.array(degrees) for degrees in (site.origin_lat_deg, site.origin_lon_deg))
    origin = [float(part) for part in tiles_at(lat, lon, 0)]
    metres = 2 * math.pi * RADIUS_M * math.cos(math.radians(site.origin_lat_deg))
    p, q = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, FITTED)] * 2))  # in extents: well conditioned
    scaled = site.extent_m / metres
    x, y = projection.to_map_many(*places_at(origin[0] + scaled * p, origin[1] - scaled * q))
    terms = np.stack([np.ones_like(p), p, q, p * p, p * q, q * q], axis=1)
    fit = np.linalg.lstsq(terms, np.stack([x, y], axis=1), rcond=None)[0].T
    return {"origin": origin, "metres": metres, "fit": (fit / site.extent_m ** np.array([0, 1, 1, 2, 2, 2])).tolist()}


def load_backdrops(path: Path) -> dict[str, Backdrop]:
    """A table per site; names of files are relative to this one's folder. ConfigError."""
    loaded = {}
    for name, table in load_toml(path).items():
        where = f"{path} [{name}]"
        if not isinstance(table, dict):
            raise ConfigError(path, f"`{name}` is no table; write `[SITE]`, the site's name, above its keys")
        config = from_table(BackdropConfig, table, where)
        picture = None if config.has_tiles or not config.base_map else path.parent / config.base_map
        if picture and not picture.is_file():
            raise ConfigError(where, f"base_map: {picture} is no file")
        rings = _rings(path.parent / config.outline, config.units) if config.outline else ()
        loaded[name] = Backdrop(config, tuple(rings), picture)
    return loaded


def _rings(path: Path, units: str) -> Iterator[Floats]:
    """The rings of a GeoJSON file's polygons, (n, 2)."""
    try:
        polygons = list(_polygons(json.loads(path.read_bytes())))
        rings = [np.array([place[:2] for place in ring], float) for polygon in polygons for ring in polygon]
    except OSError as error:
        raise ConfigError(path, f"cannot be read: {error.strerror}") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise ConfigError(path, "is no GeoJSON; a Polygon or MultiPolygon is expected") from None
    if not rings or any(ring.ndim != 2 or len(ring) < 3 for ring in rings):
        raise ConfigError(path, "holds no polygon, or one of fewer than three corners")
    if (corners := sum(map(len, rings))) > MAX_CORNERS:
        raise ConfigError(path, f"has {corners} corners, of at most {MAX_CORNERS}; simplify it")
    limits = (180.0, 90.0) if units == "degrees" else (MAX_EXTENT_M, MAX_EXTENT_M)
    for ring in rings:
        if not (np.abs(ring) <= limits).all():
            raise ConfigError(path, f"a corner is outside of +-{limits[0]:g}, +-{limits[1]:g} {units}; see `units`")
        yield ring


def _polygons(shape: dict[str, Any]) -> Iterator[Any]:
    """Coordinates of a GeoJSON object's polygons (RFC 7946)."""
    for inner in (*shape.get("features", ()), *shape.get("geometries", ()), shape.get("geometry")):
        if inner is not None:
            yield from _polygons(inner)
    if shape.get("type") in ("Polygon", "MultiPolygon"):
        yield from [shape["coordinates"]] if shape["type"] == "Polygon" else shape["coordinates"]
