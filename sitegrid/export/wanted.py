"""The exported part of a map and its time, and the queries for it."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from protocol.errors import ConfigError, QueryError, Refusal
from protocol.queries.answers import MapInfo, Region
from protocol.queries.places import where_it_lies
from protocol.queries.requests import InfoQuery, RegionQuery
from protocol.queries.roads import SegmentsQuery, Worklist, WorklistQuery
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection
from sitegrid.export.maps import OpenMap
from sitegrid.features.feature import projection_of
from sitegrid.options.parameters import dest, given

SMALLER = "give --bounds, fewer --layers, or --resolution"


@dataclass(frozen=True)
class Wanted:
    """cells, roads: the queries; roads.bounds is None for the whole map."""

    map: OpenMap
    info: MapInfo
    cells: RegionQuery
    roads: SegmentsQuery

    @cached_property
    def projection(self) -> Projection:
        """From the site's frame to latitude and longitude."""
        return projection_of(self.info.site)

    def region(self, query: RegionQuery | None = None) -> Region:
        """Layers of the cells, or of another query; refused if all are unknown."""
        try:
            region: Region = self.map.ask(query or self.cells)
        except QueryError as error:
            if error.reason != Refusal.TOO_LARGE:
                raise
            raise QueryError(error.reason, f"{error}; {SMALLER}") from None
        if not any(np.isfinite(values).any() for values in region.layers.values()):
            nothing_there(self.info)
        return region

    def worklist(self, limit: int = 1000) -> Worklist:
        """Road sections worth work."""
        roads = self.roads
        query = WorklistQuery(as_of_ns=roads.as_of_ns, bounds=roads.bounds, machine=roads.machine, limit=limit)
        answer: Worklist = self.map.ask(query)
        return answer


def parse_wanted(arguments: Namespace, opened: OpenMap) -> Wanted:
    """Parse the options; QueryError or ConfigError names the wrong one."""
    info: MapInfo = opened.ask(InfoQuery())
    if not info.bounds:
        nothing_there(info)
    whole = [edge * info.site.cell_m for edge in info.bounds]
    now_ns: Callable[[], int] = lambda: info.stamp_ns  # noqa: E731
    try:
        roads: Any = given(SegmentsQuery, _only(arguments, "as_of", "bounds", "machine"), now_ns)
        of_cells = _only(arguments, "as_of", "bounds", "layers", "resolution")
        of_cells.asked_bounds = of_cells.asked_bounds or whole
        cells: Any = given(RegionQuery, of_cells, now_ns)
    except ValueError as error:
        raise ConfigError("--bounds", str(error)) from None
    if roads.bounds and not roads.bounds.shared(Bounds(*whole)):
        nothing_there(info)
    return Wanted(opened, info, cells, roads)


def _only(arguments: Namespace, *names: str) -> Namespace:
    return Namespace(**{dest(name): getattr(arguments, dest(name)) for name in names})


def nothing_there(info: MapInfo) -> NoReturn:
    """Refuse to write an empty file."""
    problem = f"nothing is known there and then: {where_it_lies(info.bounds, info.site.cell_m)}"
    raise ConfigError(f"site {info.site.name}", problem)


def coarser(wanted: Wanted, most: int) -> RegionQuery:
    """The cells' query with larger cells, if a side has more than `most`."""
    if wanted.cells.resolution_m:
        return wanted.cells
    bounds, cell_m = wanted.cells.bounds, wanted.info.site.cell_m
    longest_m = max(bounds.east_m - bounds.west_m, bounds.north_m - bounds.south_m)
    count = int(np.ceil(longest_m / cell_m / most))
    return replace(wanted.cells, resolution_m=count * cell_m if count > 1 else None)
