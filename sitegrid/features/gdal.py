"""Features as columns, and as files written by GDAL (pyogrio)."""

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
GDAL_UTC = 100  # time zone flag (OGRFieldDefn, TZFlag)


class Columns(NamedTuple):
    """Feature columns. shapes: WKB (n,). values: by name (n,); missing: None, NaN or NaT."""

    geometry: str
    shapes: AnyArray
    values: Mapping[str, AnyArray]


def columns(collection: Collection, projection: Projection | None = None) -> Columns:
    """Columns in `map` [m]; with a projection: longitude and latitude, all multi-part."""
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
    """Write one layer. driver: GDAL's name. crs: readable by PROJ."""
    several = table.geometry.startswith("Multi")
    zones = {name: np.full(len(column), GDAL_UTC) for name, column in table.values.items() if column.dtype.kind == "M"}
    words = {"layer": layer, "crs": crs, "geometry_type": table.geometry, "driver": driver, "promote_to_multi": several}
    words["gdal_tz_offsets"] = zones
    pyogrio.raw.write(to, table.shapes, [*table.values.values()], [*table.values], **words, **options)


def in_memory(driver: str, table: Columns, layer: str, crs: str) -> bytes:
    """A one-layer file; on disk GDAL hides a full disk."""
    made = io.BytesIO()
    write(made, driver, table, layer, crs)
    return made.getvalue()


def flat_geobuf(collection: Collection, projection: Projection, layer: str) -> Iterator[bytes]:
    """FlatGeobuf in longitude and latitude; unlike GeoJSON, it has columns even if empty."""
    yield in_memory("FlatGeobuf", columns(collection, projection), layer, LAT_LON)
