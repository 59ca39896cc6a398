"""Roads and changes as tables with geometries, in the site's frame; geopandas comes with the extra `notebook`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from protocol.queries.answers import ChangesAnswer
from protocol.queries.roads import Segments, Worklist

if TYPE_CHECKING:
    import geopandas


def to_geopandas(answer: Segments | Worklist | ChangesAnswer, crs: str) -> geopandas.GeoDataFrame:
    """A row for each segment, stretch or change. Pairs become two columns: NAME along the line, NAME_back."""
    import geopandas

    rows = list(_rows(answer))
    return geopandas.GeoDataFrame(rows, columns=None if rows else ["geometry"], geometry="geometry", crs=crs)


def _rows(answer: Segments | Worklist | ChangesAnswer) -> Iterator[dict[str, Any]]:
    from shapely import LineString, box

    match answer:
        case Segments():
            for one in answer.segments:
                yield _columns(asdict(one)) | {"geometry": LineString(one.line)}
        case Worklist():
            for row in answer.rows:
                table = asdict(row)
                yield _columns(table | table.pop("segment")) | {"geometry": LineString(row.segment.line)}
        case ChangesAnswer():
            for change in answer.changes:
                yield _columns(asdict(change)) | {"geometry": box(*change.bounds)}


def _columns(table: dict[str, Any]) -> dict[str, Any]:
    """Values that a column can hold."""
    columns: dict[str, Any] = {}
    for name, value in table.items():
        if name in ("passes_ph", "tonnes_ph"):
            columns |= {name: value[0], f"{name}_back": value[1]}
        elif name in ("kwh_ph", "litres_ph", "seconds_ph"):
            columns |= {name: value[0], f"{name}_low": value[1], f"{name}_high": value[2]}
        elif not isinstance(value, tuple):
            columns[name] = value
    return columns
