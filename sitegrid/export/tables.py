"""Tables: cells, samples and features as Parquet and CSV, in chunks (pyarrow)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pyproj import CRS

from protocol.arrays import AnyArray
from protocol.queries.answers import Region
from protocol.site.site_config import Projection
from sitegrid.export.collections import COLLECTIONS
from sitegrid.export.samples import samples
from sitegrid.export.wanted import Wanted, nothing_there
from sitegrid.features.gdal import columns

ROWS = 64  # map rows per chunk: 2 MB for a site 1 km wide


def write_csv(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """A table as text; unknown values are empty fields."""
    return _written(pyarrow.csv.CSVWriter, file, wanted, what[0])


def write_parquet(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """A table as Parquet; features as GeoParquet 1.1 in the site's frame."""
    if what[0] in ("cells", "samples"):
        return _written(pyarrow.parquet.ParquetWriter, file, wanted, what[0])
    table = _of_features(wanted, what[0])
    pyarrow.parquet.write_table(table, file)
    return {what[0]: len(table)}


def _written(writer: Any, file: BinaryIO, wanted: Wanted, what: str) -> dict[str, int]:
    tables = _cells(wanted.region(), wanted.projection) if what == "cells" else map(_table, samples(wanted))
    if (first := next(iter(tables := iter(tables)), None)) is None:
        nothing_there(wanted.info)
    count = 0
    with writer(file, first.schema) as out:
        for table in chain((first,), tables):
            out.write_table(table)
            count += len(table)
    return {what: count}


def _table(values: Mapping[str, AnyArray]) -> Any:
    return pa.table({name: pa.array(column, _type(column), from_pandas=True) for name, column in values.items()})


def _type(column: AnyArray) -> Any:
    """Types that NumPy leaves open: times are UTC; texts may all be missing."""
    return {"M": pa.timestamp("ms", "UTC"), "O": pa.string()}.get(column.dtype.kind)


def _cells(region: Region, projection: Projection) -> Iterator[Any]:
    """Known cells, from the south."""
    for first in range(0, len(region.y_m), ROWS):
        part = {name: values[first : first + ROWS] for name, values in region.layers.items()}
        known = np.any([np.isfinite(values) for values in part.values()], axis=0)
        if known.any():
            rows, places = np.nonzero(known)
            x_m, y_m = region.x_m[places], region.y_m[first + rows]
            lat_deg, lon_deg, _ = projection.to_geodetic_many(x_m, y_m, np.zeros(len(x_m)))
            where = {"x_m": x_m, "y_m": y_m, "lat_deg": lat_deg, "lon_deg": lon_deg}
            yield _table({**where, **{name: values[known] for name, values in part.items()}})


def _of_features(wanted: Wanted, what: str) -> Any:
    """Features with WKB geometry and GeoParquet metadata (geoparquet.org, 1.1.0)."""
    features = columns(COLLECTIONS[what](wanted))
    shape = {"encoding": "WKB", "geometry_types": [features.geometry], "crs": CRS(wanted.info.site.crs).to_json_dict()}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": shape}}
    table = _table(features.values).append_column("geometry", pa.array(features.shapes, pa.binary()))
    return table.replace_schema_metadata({"geo": json.dumps(geo)})
