"""The map as it changes: what differs since the last look, until a program has seen enough.

What is missed while server or router are away is asked for again: the version of the last look says what that is.
"""

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

AGAIN_S = 1.0  # between two looks, by default
NEAR_TILES = 1  # layers of areas depend on cells so far away

Ask = Callable[[TilesQuery], TilesAnswer]
Read = Callable[[Bounds], Region]


def watch(ask: Ask, read: Read, bounds: Bounds | None, again_s: float, stop: Event) -> Iterator[Region]:
    """Regions of the tiles that differ, again and again; first of all that there are. Ends when `stop` is set.

    ask: for tiles since a version. read: a region. bounds: of what is watched, None for all. A server that is away is
    asked again; a QueryError about the question ends the watch.
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
    """The same for programs with an event loop, which does not wait for the server."""
    while (region := await asyncio.to_thread(next, regions, None)) is not None:
        yield region


def _areas(answer: TilesAnswer, bounds: Bounds | None) -> Iterator[Bounds]:
    """What is read: a rectangle for each row of tiles that differ, with those beside them."""
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
