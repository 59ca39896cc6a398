"""Resources of a site: what each answers, from which parameters. A new one: a function and a line in RESOURCES."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from starlette.responses import Response

from protocol.errors import Refusal
from protocol.queries.answers import MapVersion, Region
from protocol.queries.parameters import text_of
from protocol.queries.requests import NOW, PointQuery, PointsQuery, RegionQuery, WhyQuery
from sitegrid.web import features, roads, values
from sitegrid.web.encoding import PIECE, ROOM, answered, as_json, beside, frame, pieces
from sitegrid.web.resource import (
    AS_OF,
    BOUNDS,
    GEOJSON,
    LAYERS,
    PLACE,
    REPAIRS,
    WHEN,
    Resource,
    as_geojson,
    of_version,
    parsed,
    version_of,
)
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters, bad

MAX_CELLS = {"json": 250_000, "npz": 4_000_000}  # of a region; 2 MB of text a layer
MAX_VALUES = 16_000_000  # of a region, cells times layers: 64 MB
TIMES = ("as_of", "minus")
AGES = ("age_s", "changed_s")  # layers that change with the site's now


async def point(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cell at a position."""
    x_m, y_m = values.place(parameters, await feed.projection())
    rest = {name: text for name, text in parameters.items() if name not in PLACE}
    query = parsed("point", {**rest, "x": text_of(x_m), "y": text_of(y_m)}, TIMES)
    assert isinstance(query, PointQuery)
    ask = feed.ask if query.when == NOW else feed.ask_for_much
    answer = await ask(feed.client.point, query.x_m, query.y_m, query.layers, **vars(query.when))
    lat_deg, lon_deg, _ = (await feed.projection()).to_geodetic(answer.x_m, answer.y_m)
    place = {"x_m": answer.x_m, "y_m": answer.y_m, "lat_deg": lat_deg, "lon_deg": lon_deg}
    table = {**place, "values": answer.values, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


async def points(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cells at many positions, in their order."""
    query = parsed("points", parameters, TIMES, ("places",))
    assert isinstance(query, PointsQuery)
    answer = await feed.ask_for_much(feed.client.points, query.places, query.layers, **vars(query.when))
    columns = {"x_m": answer.x_m, "y_m": answer.y_m, "layers": answer.layers}
    table = {**columns, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


async def why(feed: SiteFeed, parameters: Parameters) -> Response:
    """Everything that is known of the cell at a position."""
    x_m, y_m = values.place(parameters, await feed.projection())
    rest = {name: text for name, text in parameters.items() if name not in PLACE}
    query = parsed("why", {**rest, "x": text_of(x_m), "y": text_of(y_m)}, TIMES)
    assert isinstance(query, WhyQuery)
    ask = feed.ask_for_much if query.as_of_ns or query.repairs else feed.ask
    answer = await ask(feed.client.why, query.x_m, query.y_m, as_of_ns=query.as_of_ns, repairs=query.repairs)
    return of_version(await as_json(answer), MapVersion(answer.store, answer.merged, answer.fact))


async def region(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cells that a rectangle touches, or that lie in a polygon; or of larger cells."""
    kind = parameters.get("format", "json")
    if kind not in MAX_CELLS:
        raise bad(Refusal.OUT_OF_RANGE, "parameter `format`: json or npz")
    rest = {name: text for name, text in parameters.items() if name != "format"}
    query = parsed("region", rest, TIMES, ("polygon",))
    assert isinstance(query, RegionQuery)
    info_now, (west, south, east, north) = await feed.info(), vars(query.bounds).values()
    cell_m, layers = query.resolution_m or info_now.site.cell_m, len(query.layers) or len(info_now.layers)
    cells = round((east - west + cell_m) * (north - south + cell_m) / cell_m**2)
    if cells > (most := min(MAX_CELLS[kind], MAX_VALUES // layers)):
        problem = f"a region of about {cells} cells; at most {most} with {layers} layers as {kind}"
        raise bad(Refusal.TOO_LARGE, f"{problem}: ask for less, fewer `layers`, or larger cells with `resolution`")
    asked = {"resolution_m": query.resolution_m, **vars(query.when)}
    done = ROOM.take(4 * cells * layers)
    try:
        answer = await feed.ask_for_much(feed.client.region, query.area, query.layers, **asked)
        parts = await beside(_archive, answer) if kind == "npz" else pieces(_table(answer))
        return of_version(await answered(parts, REGION_MEDIA[kind], done), answer.version)
    except BaseException:
        done()
        raise


REGION_MEDIA = {"json": "application/json", "npz": "application/x-npz"}


def _table(answer: Region) -> dict[str, Any]:
    axes = {"x_m": answer.x_m, "y_m": answer.y_m, "cell_m": answer.cell_m}
    return {**axes, "layers": answer.layers, **version_of(answer.version), "stamp_ns": answer.stamp_ns}


def _archive(answer: Region) -> Iterator[bytes]:
    """An NPZ file, in pieces."""
    file, version = io.BytesIO(), np.array([answer.version.row, answer.version.fact])
    np.savez_compressed(file, x_m=answer.x_m, y_m=answer.y_m, version=version, **answer.layers)  # type: ignore[arg-type]
    file.seek(0)
    return iter(lambda: file.read(PIECE), b"")


async def history(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cell at a position, span by span."""
    x_m, y_m = values.place(parameters, await feed.projection())
    times = {"from_ns": values.stamp(parameters, "from"), "to_ns": values.stamp(parameters, "to")}
    span_s = values.number(parameters, "span") if "span" in parameters else None
    spans = await feed.ask_for_much(feed.client.history, x_m, y_m, values.layers(parameters), **times, span_s=span_s)
    return await as_json({"spans": spans})


async def info(feed: SiteFeed, _: Parameters) -> Response:
    """State of the map and of its server."""
    return await as_json(await feed.info(0.0))


async def machines(feed: SiteFeed, _: Parameters) -> Response:
    """What the map server knows of each machine."""
    return await as_json({"machines": await feed.ask(feed.client.machines)})


async def calibration(feed: SiteFeed, _: Parameters) -> Response:
    """What is taken off the samples of each machine, and what is known of its calibration."""
    return await as_json(await feed.ask(feed.client.calibration))


async def changes(feed: SiteFeed, parameters: Parameters) -> Response:
    """Changes of the ground."""
    after = values.number(parameters, "after", 0.0)
    if after < 0 or after != int(after):
        raise bad(Refusal.OUT_OF_RANGE, f"parameter `after`: {after:g} is no whole number from 0 on")
    return await as_json({"changes": await feed.ask(feed.client.changes, int(after))})


async def tiles(feed: SiteFeed, parameters: Parameters) -> Response:
    """The map in tiles of 8-bit layers, as the live page reads it: all, those since a version, or as of a time."""
    as_of_ns = values.stamp(parameters, "as_of")
    if as_of_ns is not None:
        answer = await feed.tiles_as_of(as_of_ns)
    else:
        known = {"store", "row", "fact"} & set(parameters)
        numbers = (int(values.number(parameters, name, -1.0)) for name in ("row", "fact"))
        since = MapVersion(parameters.get("store", ""), *numbers) if known else None
        answer = await feed.ask(feed.client.tiles, since)
    return Response(await beside(frame, answer), media_type="application/octet-stream")


async def zones(feed: SiteFeed, _: Parameters) -> Response:
    """Areas of one kind of ground, as features."""
    info_now = await feed.info()
    answer = await feed.ask(feed.client.tiles)
    return await as_geojson(features.zones, answer, info_now.boundaries, await feed.projection())


async def change_features(feed: SiteFeed, _: Parameters) -> Response:
    """Changes of the ground, as features."""
    ground_changes = await feed.ask(feed.client.changes)
    return await as_geojson(features.changes, ground_changes, await feed.projection())


async def machine_features(feed: SiteFeed, _: Parameters) -> Response:
    """Where machines are, as features: those that said so while somebody looks."""
    async with feed.watched():
        await feed.heard()
        return await as_geojson(features.machines, feed.poses(), await feed.projection())


async def track_features(feed: SiteFeed, _: Parameters) -> Response:
    """Where machines drove while somebody looked, as features."""
    async with feed.watched():
        await feed.heard()
        return await as_geojson(features.tracks, feed.tracks(), await feed.projection())


RESOURCES: dict[str, Resource] = {
    "info": Resource(info, "State of the map and of its server", {}, follows_now=True),
    "point": Resource(point, "Layers of the cell at a position", {**PLACE, **LAYERS, **WHEN}),
    "points": Resource(
        points, "Layers of the cells at many positions", {"places": "x,y;x,y;... [m]", **LAYERS, **WHEN}
    ),
    "why": Resource(why, "Why the cell at a position has its value", {**PLACE, **AS_OF, **REPAIRS}),
    "region": Resource(
        region,
        "Layers of a rectangle or a polygon of cells",
        {
            **BOUNDS,
            "polygon": "in place of bounds: x,y;x,y;... [m]",
            "resolution": "edge of larger cells [m], each the mean of what is known in it",
            **LAYERS,
            **WHEN,
            "format": "json or npz",
        },
        tuple(REGION_MEDIA.values()),
    ),
    "history": Resource(
        history,
        "The cell at a position over time",
        {**PLACE, **LAYERS, "from": "first time", "to": "last time", "span": "length of a span [s]"},
        follows_now=True,
    ),
    "machines": Resource(machines, "What is known of each machine", {}, follows_now=True),
    "calibration": Resource(calibration, "How machines are calibrated and corrected", {}, follows_now=True),
    "changes": Resource(changes, "Changes of the ground", {"after": "with a number beyond this one"}, follows_now=True),
    "tiles": Resource(
        tiles,
        "The map in tiles of 8-bit layers",
        {**AS_OF, "store": "of the version that the asker has", "row": "its row", "fact": "its fact"},
        ("application/octet-stream",),
        follows_now=True,
    ),
    **roads.RESOURCES,
    "features/zones": Resource(zones, "Areas of one kind of ground", {}, GEOJSON),
    "features/changes": Resource(change_features, "Changes of the ground as areas", {}, GEOJSON, follows_now=True),
    "features/machines": Resource(machine_features, "Positions of machines", {}, GEOJSON, follows_now=True),
    "features/tracks": Resource(track_features, "Lines that machines drove", {}, GEOJSON, follows_now=True),
}


def follows_now(resource: Resource, parameters: Parameters) -> bool:
    """Whether an answer may be another one although the map is not."""
    names = values.layers(parameters)
    ages = "layers" in resource.parameters and (not names or any(name in AGES for name in names))
    return "as_of" not in parameters and (resource.follows_now or ages)
