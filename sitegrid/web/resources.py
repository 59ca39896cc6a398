"""Resources of a site: what each answers, from which parameters. A new one: a function and a line in RESOURCES."""

from __future__ import annotations

import io

import numpy as np
from starlette.responses import Response

from protocol.errors import Refusal
from protocol.queries.answers import MapVersion
from protocol.queries.parameters import text_of
from protocol.queries.requests import PointQuery, PointsQuery, RegionQuery, WhyQuery
from sitegrid.web import features, roads, values
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
    as_json,
    of_version,
    parsed,
    version_of,
)
from sitegrid.web.site import SiteFeed, frame
from sitegrid.web.values import Parameters, bad

MAX_CELLS_JSON = 250_000  # of a region as text: 2 MB a layer
MAX_CELLS_NPZ = 4_000_000
TIMES = ("as_of", "minus")
AGES = ("age_s", "changed_s")  # layers that change with the site's now


async def point(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cell at a position."""
    x_m, y_m = values.place(parameters, await feed.projection())
    rest = {name: text for name, text in parameters.items() if name not in PLACE}
    query = parsed("point", {**rest, "x": text_of(x_m), "y": text_of(y_m)}, TIMES)
    assert isinstance(query, PointQuery)
    answer = await feed.ask(feed.client.point, query.x_m, query.y_m, query.layers, **vars(query.when))
    lat_deg, lon_deg, _ = (await feed.projection()).to_geodetic(answer.x_m, answer.y_m)
    place = {"x_m": answer.x_m, "y_m": answer.y_m, "lat_deg": lat_deg, "lon_deg": lon_deg}
    table = {**place, "values": answer.values, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(as_json(table), answer.version)


async def points(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cells at many positions, in their order."""
    query = parsed("points", parameters, TIMES, ("places",))
    assert isinstance(query, PointsQuery)
    answer = await feed.ask(feed.client.points, query.places, query.layers, **vars(query.when))
    columns = {"x_m": answer.x_m, "y_m": answer.y_m, "layers": answer.layers}
    table = {**columns, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(as_json(table), answer.version)


async def why(feed: SiteFeed, parameters: Parameters) -> Response:
    """Everything that is known of the cell at a position."""
    x_m, y_m = values.place(parameters, await feed.projection())
    rest = {name: text for name, text in parameters.items() if name not in PLACE}
    query = parsed("why", {**rest, "x": text_of(x_m), "y": text_of(y_m)}, TIMES)
    assert isinstance(query, WhyQuery)
    answer = await feed.ask(feed.client.why, query.x_m, query.y_m, as_of_ns=query.as_of_ns, repairs=query.repairs)
    return of_version(as_json(answer), MapVersion(answer.store, answer.merged, answer.fact))


async def region(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cells that a rectangle touches, or that lie in a polygon; or of larger cells."""
    as_npz = parameters.get("format", "json") == "npz"
    if parameters.get("format", "json") not in ("json", "npz"):
        raise bad(Refusal.OUT_OF_RANGE, "parameter `format`: json or npz")
    rest = {name: text for name, text in parameters.items() if name != "format"}
    query = parsed("region", rest, TIMES, ("polygon",))
    assert isinstance(query, RegionQuery)
    cell_m = query.resolution_m or (await feed.info()).site.cell_m
    bounds = query.bounds
    cells = (bounds.east_m - bounds.west_m) * (bounds.north_m - bounds.south_m) / cell_m**2
    if cells > (most := MAX_CELLS_NPZ if as_npz else MAX_CELLS_JSON):
        problem = f"a region of about {cells:.0f} cells; at most {most} as {'npz' if as_npz else 'json'}"
        raise bad(Refusal.TOO_LARGE, f"{problem}: ask for less, or for larger cells with `resolution`")
    asked = {"resolution_m": query.resolution_m, **vars(query.when)}
    answer = await feed.ask(feed.client.region, query.area, query.layers, **asked)
    layers = dict(answer.layers)
    if as_npz:
        file = io.BytesIO()
        version = np.array([answer.version.row, answer.version.fact])
        np.savez_compressed(file, x_m=answer.x_m, y_m=answer.y_m, version=version, **layers)  # type: ignore[arg-type]
        return of_version(Response(file.getvalue(), media_type="application/x-npz"), answer.version)
    axes = {"x_m": answer.x_m, "y_m": answer.y_m, "cell_m": answer.cell_m}
    table = {**axes, "layers": layers, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(as_json(table), answer.version)


async def history(feed: SiteFeed, parameters: Parameters) -> Response:
    """Layers of the cell at a position, span by span."""
    x_m, y_m = values.place(parameters, await feed.projection())
    times = {"from_ns": values.stamp(parameters, "from"), "to_ns": values.stamp(parameters, "to")}
    span_s = values.number(parameters, "span") if "span" in parameters else None
    spans = await feed.ask(feed.client.history, x_m, y_m, values.layers(parameters), **times, span_s=span_s)
    return as_json({"spans": spans})


async def info(feed: SiteFeed, _: Parameters) -> Response:
    """State of the map and of its server."""
    return as_json(await feed.info(0.0))


async def machines(feed: SiteFeed, _: Parameters) -> Response:
    """What the map server knows of each machine."""
    return as_json({"machines": await feed.ask(feed.client.machines)})


async def calibration(feed: SiteFeed, _: Parameters) -> Response:
    """What is taken off the samples of each machine, and what is known of its calibration."""
    return as_json(await feed.ask(feed.client.calibration))


async def changes(feed: SiteFeed, parameters: Parameters) -> Response:
    """Changes of the ground."""
    after = values.number(parameters, "after", 0.0)
    if after < 0 or after != int(after):
        raise bad(Refusal.OUT_OF_RANGE, f"parameter `after`: {after:g} is no whole number from 0 on")
    return as_json({"changes": await feed.ask(feed.client.changes, int(after))})


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
    return Response(frame(answer), media_type="application/octet-stream")


async def zones(feed: SiteFeed, _: Parameters) -> Response:
    """Areas of one kind of ground, as features."""
    info_now = await feed.info()
    answer = await feed.ask(feed.client.tiles)
    return as_geojson(features.zones(answer, info_now.boundaries, await feed.projection()))


async def change_features(feed: SiteFeed, _: Parameters) -> Response:
    """Changes of the ground, as features."""
    ground_changes = await feed.ask(feed.client.changes)
    return as_geojson(features.changes(ground_changes, await feed.projection()))


async def machine_features(feed: SiteFeed, _: Parameters) -> Response:
    """Where machines are, as features: those that said so while somebody looks."""
    async with feed.watched():
        await feed.heard()
        return as_geojson(features.machines(feed.poses(), await feed.projection()))


async def track_features(feed: SiteFeed, _: Parameters) -> Response:
    """Where machines drove while somebody looked, as features."""
    async with feed.watched():
        await feed.heard()
        return as_geojson(features.tracks(feed.tracks(), await feed.projection()))


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
        ("application/json", "application/x-npz"),
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
