"""Features as columns, and as files that GDAL writes (pyogrio)."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyogrio.raw
import shapely

from protocol.arrays import AnyArray
from protocol.site.site_config import Projection
from sitegrid.features.feature import Collection, Time, shape_of

LAT_LON = "EPSG:4326"
GDAL_UTC = 100  # the time zone (OGRFieldDefn, TZFlag)


class Columns(NamedTuple):
    """Features side by side. shapes: WKB (n,). values: by name (n,), missing ones None, NaN or NaT."""

    geometry: str
    shapes: AnyArray
    values: Mapping[str, AnyArray]


def columns(collection: Collection, projection: Projection | None = None) -> Columns:
    """Columns of a collection, in `map` [m]; with a projection in longitude and latitude, all of several parts."""
    kind, shapes, rows = collection.kind, [], []
    for item in collection.items:
        shapes.append(shapely.to_wkb(shapely.geometry.shape(shape_of(kind, item, projection))))
        rows.append(collection.properties(item))
    values = {name: _column([row[name] for row in rows], field_type) for name, (field_type, _) in kind.fields.items()}
    parts = "Multi" if projection and kind.geometry != "Point" else ""
    return Columns(parts + kind.geometry, np.array(shapes, object), values)


def _column(values: Sequence[Any], kind: type) -> AnyArray:
    if kind is Time:
        times = ["NaT" if value is None else value.removesuffix("Z") for value in values]
        return np.array(times, "datetime64[ns]").astype("datetime64[ms]")
    if kind is float:
        return np.array([np.nan if value is None else value for value in values], np.float64)
    return np.array(values, object if kind is str else kind)


def write(to: io.BytesIO | Path, driver: str, table: Columns, layer: str, crs: str, **options: Any) -> None:
    """Write one layer. driver: as GDAL names it; crs: as PROJ reads it."""
    several = table.geometry.startswith("Multi")
    zones = {name: np.full(len(column), GDAL_UTC) for name, column in table.values.items() if column.dtype.kind == "M"}
    words = {"layer": layer, "crs": crs, "geometry_type": table.geometry, "driver": driver, "promote_to_multi": several}
    words["gdal_tz_offsets"] = zones
    pyogrio.raw.write(to, table.shapes, [*table.values.values()], [*table.values], **words, **options)


def in_memory(driver: str, table: Columns, layer: str, crs: str) -> bytes:
    """A file of one layer; on disk GDAL hides that there is no room."""
    made = io.BytesIO()
    write(made, driver, table, layer, crs)
    return made.getvalue()


def flat_geobuf(collection: Collection, projection: Projection, layer: str) -> Iterator[bytes]:
    """A FlatGeobuf file in longitude and latitude: unlike GeoJSON, an empty one says what its features will be."""
    yield in_memory("FlatGeobuf", columns(collection, projection), layer, LAT_LON)
