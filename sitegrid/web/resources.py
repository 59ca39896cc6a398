"""A site's resources. A new one: a function and a line in RESOURCES."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from starlette.responses import Response

from protocol.arrays import Floats
from protocol.errors import Refusal
from protocol.queries.answers import MapVersion, Region
from protocol.queries.lanes import STROKES, LanesAnswer, LanesQuery, strokes
from protocol.queries.map_tiles import PLANES, TilesAnswer, TilesQuery
from protocol.queries.parameters import WORDS, name_of
from protocol.queries.request import MapQuery, Parameter, parameters_of
from protocol.queries.requests import (
    QUERIES,
    ChangesQuery,
    HistoryQuery,
    InfoQuery,
    MachinesQuery,
    PointQuery,
    PointsQuery,
    RegionQuery,
    WhyQuery,
)
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery
from protocol.queries.route_requests import LineQuery, RouteQuery, WayQuery
from sitegrid.features.feature import Collection
from sitegrid.features.kinds import CHANGE, MACHINE, REPAIR, SEGMENT, WORK, tracks
from sitegrid.features.zones import zones
from sitegrid.web.encoding import PIECE, Column, answered, as_json, framed, in_room, pieces
from sitegrid.web.resource import Resource, as_features, of_features, of_version, version_of
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters, bad

MAX_CELLS = {"json": 250_000, "npz": 4_000_000}  # of a region; 2 MB of text per layer
MAX_VALUES = 16_000_000  # cells times layers: 64 MB
ZONES_BYTES = 32  # per known cell: its tile, and a picture with its outlines where the ground has no pattern
TILES_AT_ONCE = 256  # of lanes, as columns: 2 MB
AGES = ("age_s", "changed_s")  # layers that depend on the site's now


async def point(feed: SiteFeed, query: PointQuery, _: Parameters) -> Response:
    """Layers of the cell at a position."""
    answer = await feed.answer_to(query)
    lat_deg, lon_deg, _height_m = (await feed.projection()).to_geodetic(answer.x_m, answer.y_m)
    place = {"x_m": answer.x_m, "y_m": answer.y_m, "lat_deg": lat_deg, "lon_deg": lon_deg}
    table = {**place, "values": answer.values, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


async def points(feed: SiteFeed, query: PointsQuery, _: Parameters) -> Response:
    """Layers of the cells at many positions, in order."""
    answer = await feed.answer_to(query)
    columns = {"x_m": answer.x_m, "y_m": answer.y_m, "layers": answer.layers}
    table = {**columns, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


async def region(feed: SiteFeed, query: RegionQuery, more: Parameters) -> Response:
    """Layers of cells touched by a rectangle or inside a polygon, optionally coarser."""
    kind = more.get("format", "json")
    if kind not in MAX_CELLS:
        raise bad(Refusal.OUT_OF_RANGE, "parameter `format`: json or npz")
    info_now, (west, south, east, north) = await feed.info(), vars(query.bounds).values()
    cell_m, layers = query.resolution_m or info_now.site.cell_m, len(query.layers) or len(info_now.layers)
    cells = round((east - west + cell_m) * (north - south + cell_m) / cell_m**2)
    if cells > (most := min(MAX_CELLS[kind], MAX_VALUES // layers)):
        problem = f"a region of about {cells} cells; at most {most} with {layers} layers as {kind}"
        raise bad(Refusal.TOO_LARGE, f"{problem}: ask for less, fewer `layers`, or larger cells with `resolution`")
    return await in_room(4 * cells * layers, lambda: _region(feed, query, kind))


async def _region(feed: SiteFeed, query: RegionQuery, kind: str) -> Response:
    answer = await feed.answer_to(query)
    parts = _archive(answer) if kind == "npz" else pieces(_table(answer))
    return of_version(await answered(parts, REGION_MEDIA[kind]), answer.version)


REGION_MEDIA = {"json": "application/json", "npz": "application/x-npz"}


def _table(answer: Region) -> dict[str, Any]:
    axes = {"x_m": answer.x_m, "y_m": answer.y_m, "cell_m": answer.cell_m}
    return {**axes, "layers": answer.layers, **version_of(answer.version), "stamp_ns": answer.stamp_ns}


def _archive(answer: Region) -> Iterator[bytes]:
    """NPZ in pieces, compressed as they are taken."""
    version, sink = np.array([answer.version.row, answer.version.fact]), _Sink()
    arrays = {"x_m": answer.x_m, "y_m": answer.y_m, "version": version, **answer.layers}
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
                flat = array.reshape(-1)
                for first in range(0, len(flat), PIECE):
                    file.write(flat[first : first + PIECE].tobytes())
                    if len(sink.written) >= PIECE:
                        yield sink.taken()
    yield sink.taken()


class _Sink(io.RawIOBase):
    """Bytes on their way: written to the end, taken from the beginning."""

    def __init__(self) -> None:
        self.written = bytearray()

    def writable(self) -> bool:
        """It is."""
        return True

    def write(self, data: Any) -> int:
        """Append."""
        self.written += data
        return len(data)

    def taken(self) -> bytes:
        """What was written since."""
        data = bytes(self.written)
        self.written.clear()
        return data


async def history(feed: SiteFeed, query: HistoryQuery, _: Parameters) -> Response:
    """Layers of a cell by time span."""
    return await as_json({"spans": (await feed.answer_to(query)).spans})


async def info(feed: SiteFeed, _: InfoQuery, __: Parameters) -> Response:
    """Current state of map and server."""
    return await as_json(await feed.info(0.0))


async def machines(feed: SiteFeed, query: MachinesQuery, _: Parameters) -> Response:
    """The map server's view of each machine."""
    return await as_json({"machines": (await feed.answer_to(query)).machines})


async def agents(feed: SiteFeed, _: None, __: Parameters) -> Response:
    """Machines' own status, heard while somebody looks."""
    async with feed.watched():
        await feed.heard()
        return await as_json({"agents": feed.reports()})


async def changes(feed: SiteFeed, query: ChangesQuery, _: Parameters) -> Response:
    """Ground changes."""
    return await as_json({"changes": (await feed.answer_to(query)).changes})


async def as_it_is(feed: SiteFeed, query: MapQuery[Any], _: Parameters) -> Response:
    """An answer as a record of a map version."""
    answer = await feed.answer_to(query)
    return of_version(await as_json(answer), MapVersion(answer.store, answer.merged, answer.fact))


async def lanes(feed: SiteFeed, query: LanesQuery, _: Parameters) -> Response:
    """Driven cells as columns: place, prevailing heading, metres driven so."""
    answer = await feed.answer_to(query)
    columns = {name: Column(_strokes(answer, name)) for name in STROKES}
    held = sum(tile.metres.nbytes for tile in answer.tiles)
    making = partial(as_json, {**columns, "stamp_ns": answer.stamp_ns})
    return of_version(await in_room(held, making), answer.version)


def _strokes(answer: LanesAnswer, name: str) -> Iterator[Floats]:
    """A column of driven cells, some tiles at a time: all would take ten times the answer."""
    for first in range(0, len(answer.tiles), TILES_AT_ONCE):
        yield strokes(replace(answer, tiles=answer.tiles[first : first + TILES_AT_ONCE]))[name]


async def tiles(feed: SiteFeed, query: TilesQuery, _: Parameters) -> Response:
    """Map tiles of 8-bit layers, as for the live page: all, since a version, or as of a time."""
    making = partial(feed.answer_to, query) if query.as_of_ns is None else partial(feed.tiles_as_of, query.as_of_ns)
    return await in_room(len(PLANES) * (await feed.info()).cells, lambda: _framed(making))


async def _framed(asking: Callable[[], Awaitable[TilesAnswer]]) -> Response:
    return await answered(framed(await asking()), BINARY[0])


async def zone_features(feed: SiteFeed, query: TilesQuery, more: Parameters) -> Response:
    """Ground areas by class, as features."""
    boundaries = (await feed.info()).boundaries

    async def making() -> Response:
        return await as_features(feed, more, "zones", zones(await feed.answer_to(query), boundaries))

    return await in_room(ZONES_BYTES * (await feed.info()).cells, making)


async def change_features(feed: SiteFeed, query: ChangesQuery, more: Parameters) -> Response:
    """Ground changes as features."""
    return await as_features(feed, more, "changes", Collection(CHANGE, (await feed.answer_to(query)).changes))


async def machine_features(feed: SiteFeed, _: None, more: Parameters) -> Response:
    """Machine positions, heard while somebody looks, as features."""
    async with feed.watched():
        await feed.heard()
        return await as_features(feed, more, "machines", Collection(MACHINE, feed.poses()))


async def track_features(feed: SiteFeed, _: None, more: Parameters) -> Response:
    """Tracks, heard while somebody looks, as features."""
    async with feed.watched():
        await feed.heard()
        return await as_features(feed, more, "tracks", tracks(feed.tracks()))


async def segment_features(feed: SiteFeed, query: SegmentsQuery, more: Parameters) -> Response:
    """Roads as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "segments", Collection(SEGMENT, answer.segments)), answer)


async def worklist_features(feed: SiteFeed, query: WorklistQuery, more: Parameters) -> Response:
    """Sections worth work, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "worklist", Collection(WORK, answer.rows)), answer)


async def repair_features(feed: SiteFeed, query: WorklistQuery, more: Parameters) -> Response:
    """Sections whose ground changed, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "repairs", Collection(REPAIR, answer.changes)), answer)


async def drive(feed: SiteFeed, query: LineQuery, _: Parameters) -> Response:
    """Cost of a drive along a given or cheapest line."""
    answer = await feed.answer_to(query)
    totals = {**asdict(answer.totals), "litres": answer.totals.litres}
    ground = {"line": answer.line_m, "totals": totals, "steps": vars(answer.steps), "machine": asdict(answer.machine)}
    table = {**ground, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


def _of_map(response: Response, answer: Segments | Worklist) -> Response:
    return of_version(response, MapVersion(answer.store, answer.merged, answer.fact))


FORMAT = Parameter("format", "json or npz", name_of())
BINARY = ("application/octet-stream",)
REPAIRS = "Stretches that were repaired or became worse, as lines"
ZONES = "Areas of one kind of ground"
EVERY_TILE = tuple(parameters_of(TilesQuery))
RESOURCES: dict[str, Resource] = {
    "info": Resource(info, InfoQuery.help, InfoQuery, follows_now=True),
    "point": Resource(point, PointQuery.help, PointQuery),
    "points": Resource(points, PointsQuery.help, PointsQuery),
    "why": Resource(as_it_is, WhyQuery.help, WhyQuery),
    "region": Resource(region, RegionQuery.help, RegionQuery, more=(FORMAT,), media=tuple(REGION_MEDIA.values())),
    "history": Resource(history, HistoryQuery.help, HistoryQuery, follows_now=True),
    "machines": Resource(machines, MachinesQuery.help, MachinesQuery, follows_now=True),
    "agents": Resource(agents, "What each machine says of itself: what it lacks, what waits", follows_now=True),
    "lanes": Resource(lanes, LanesQuery.help, LanesQuery, follows_now=True),
    "changes": Resource(changes, ChangesQuery.help, ChangesQuery, follows_now=True),
    "tiles": Resource(tiles, TilesQuery.help, TilesQuery, without=("place",), media=BINARY, follows_now=True),
    "features/segments": of_features(segment_features, "Roads as lines", SegmentsQuery),
    "features/worklist": of_features(worklist_features, "The worklist as lines", WorklistQuery),
    "features/repairs": of_features(repair_features, REPAIRS, WorklistQuery, ("limit", "efficiency")),
    "route": Resource(drive, RouteQuery.help, RouteQuery),
    "way": Resource(drive, WayQuery.help, WayQuery),
    "features/zones": of_features(zone_features, ZONES, TilesQuery, EVERY_TILE, follows_now=False),
    "features/changes": of_features(change_features, "Changes of the ground as areas", ChangesQuery, ("after",)),
    "features/machines": of_features(machine_features, "Positions of machines"),
    "features/tracks": of_features(track_features, "Lines that machines drove"),
}
# Other queries answer with their records' fields.
RESOURCES |= {
    name: Resource(as_it_is, query.help, query, follows_now=True)
    for name, query in QUERIES.items()
    if name not in (*RESOURCES, "piece", "alive")
}


def follows_now(resource: Resource, parameters: Parameters) -> bool:
    """Whether an answer may change without the map."""
    names = WORDS.read("layers", parameters.get("layers", ""))
    ages = "layers" in resource.parameters and (not names or any(name in AGES for name in names))
    return "as_of" not in parameters and (resource.follows_now or ages)
