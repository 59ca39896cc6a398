"""Features: geometries in `map` [m] with typed properties; their GeoJSON (RFC 7946)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import reduce
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.queries.answers import SiteInfo
from protocol.site.site_config import Projection, SiteConfig
from sitegrid.features.meridian import geometry
from sitegrid.times import iso

Time = datetime  # type of time fields: ISO 8601 in UTC, from a stamp


@dataclass(frozen=True)
class FeatureKind:
    """Type of a collection's features, so that even an empty one has columns.

    geometry: Point, LineString or Polygon. lines: corners (n, 2) in `map` [m] of an item: a point, a line, or closed
    rings. fields: each property's type and its dotted path of attributes, keys and indices. Properties may be None.
    """

    geometry: str
    lines: Callable[[Any], list[Floats]]
    fields: Mapping[str, tuple[type, str]]


@dataclass(frozen=True)
class Collection:
    """Items of one kind; may be a one-time iterator."""

    kind: FeatureKind
    items: Iterable[Any]

    def properties(self, item: Any) -> dict[str, Any]:
        """An item's properties."""
        table = {
            name: (field_type, reduce(_part, path.split("."), item))
            for name, (field_type, path) in self.kind.fields.items()
        }
        return {name: iso(value) if field_type is Time else value for name, (field_type, value) in table.items()}


def _part(item: Any, name: str) -> Any:
    if item is None:
        return None
    if isinstance(item, Mapping):
        return item[name]
    return item[int(name)] if name.isdigit() else getattr(item, name)


def projection_of(site: SiteInfo) -> Projection:
    """From a site's frame to latitude and longitude."""
    return Projection(SiteConfig(site.name, site.origin_lat_deg, site.origin_lon_deg, site.origin_height_m))


def geojson(collection: Collection, projection: Projection) -> dict[str, Any]:
    """GeoJSON in longitude and latitude [deg]; features are lazy."""
    return {"type": "FeatureCollection", "features": _geojson(collection, projection)}


def _geojson(collection: Collection, projection: Projection) -> Iterator[dict[str, Any]]:
    for item in collection.items:
        shape = shape_of(collection.kind, item, projection)
        yield {"type": "Feature", "geometry": shape, "properties": collection.properties(item)}


def shape_of(kind: FeatureKind, item: Any, projection: Projection | None) -> dict[str, Any]:
    """GeoJSON geometry: longitude, latitude [deg], cut at the 180th meridian; without projection [m]."""
    lines = [_degrees(line, projection) if projection else line.tolist() for line in kind.lines(item)]
    nested: Any = lines if kind.geometry == "Polygon" else lines[0]
    nested = nested[0] if kind.geometry == "Point" else nested
    return geometry(kind.geometry, nested) if projection else {"type": kind.geometry, "coordinates": nested}


def _degrees(line: Floats, projection: Projection) -> list[list[float]]:
    x_m, y_m = np.asarray(line, np.float64).T
    lat_deg, lon_deg, _ = projection.to_geodetic_many(x_m, y_m, np.zeros(len(x_m)))
    corners: list[list[float]] = np.stack([lon_deg, lat_deg], axis=1).round(8).tolist()
    return corners
