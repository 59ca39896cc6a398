"""Watch the map: regions that changed since the last look. After an outage the last version says what was missed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator
from threading import Event

from protocol.errors import LinkError, MessageError, QueryError, Refusal
from protocol.queries.answers import MapVersion, Region
from protocol.queries.map_tiles import TILE_CELLS, MapTile, TilesAnswer, TilesQuery
from protocol.site.geometry import Bounds
from sitegrid.follower_choice import ELSEWHERE

AGAIN_S = 1.0  # default interval
NEAR_TILES = 1  # reach of area layers

Ask = Callable[[TilesQuery], TilesAnswer]
Read = Callable[[Bounds], Region]


def watch(ask: Ask, read: Read, bounds: Bounds | None, again_s: float, stop: Event) -> Iterator[Region]:
    """Regions of changed tiles, endlessly, first of all tiles; ends when `stop` is set.

    ask: tiles since a version. read: a region. bounds: None: everywhere. Outages are retried; a QueryError about the
    query is raised.
    """
    version: MapVersion | None = None
    while not stop.is_set():
        began_s = time.monotonic()
        try:
            answer = ask(TilesQuery(version))
            for area in _areas(answer, bounds):
                yield read(area)
            version = answer.version
        except (LinkError, MessageError):
            pass
        except QueryError as error:
            if error.reason not in (*ELSEWHERE, Refusal.EXPIRED):
                raise
        stop.wait(max(0.0, again_s - (time.monotonic() - began_s)))


async def watch_async(regions: Iterator[Region]) -> AsyncIterator[Region]:
    """The same without blocking an event loop."""
    while (region := await asyncio.to_thread(next, regions, None)) is not None:
        yield region


def _areas(answer: TilesAnswer, bounds: Bounds | None) -> Iterator[Bounds]:
    """One rectangle per row of changed tiles, with their neighbours."""
    edge_m = TILE_CELLS * answer.cell_m
    rows: dict[int, list[MapTile]] = {}
    for tile in answer.tiles:
        rows.setdefault(tile.y, []).append(tile)
    for y, tiles in sorted(rows.items()):
        west, east = min(tile.x for tile in tiles), max(tile.x for tile in tiles)
        corners = (west - NEAR_TILES, y - NEAR_TILES, east + 1 + NEAR_TILES, y + 1 + NEAR_TILES)
        area = Bounds(*(edge_m * corner for corner in corners))
        if shared := area.shared(bounds) if bounds else area:
            yield shared
