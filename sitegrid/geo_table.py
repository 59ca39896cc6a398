"""Roads and changes as tables with geometries, in the site's frame; geopandas comes with the extra `notebook`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protocol.queries.answers import ChangesAnswer
from protocol.queries.roads import Segments, Worklist
from sitegrid.features.feature import Collection, shape_of
from sitegrid.features.kinds import CHANGE, SEGMENT, WORK

if TYPE_CHECKING:
    import geopandas


def to_geopandas(answer: Segments | Worklist | ChangesAnswer, crs: str) -> geopandas.GeoDataFrame:
    """A row for each segment, stretch or change, with the columns that exported files have too."""
    import geopandas
    from shapely.geometry import shape

    match answer:
        case Segments():
            features = Collection(SEGMENT, answer.segments)
        case Worklist():
            features = Collection(WORK, answer.rows)
        case ChangesAnswer():
            features = Collection(CHANGE, answer.changes)
    rows = [
        {**features.properties(one), "geometry": shape(shape_of(features.kind, one, None))} for one in features.items
    ]
    return geopandas.GeoDataFrame(rows, columns=[*features.kind.fields, "geometry"], geometry="geometry", crs=crs)
