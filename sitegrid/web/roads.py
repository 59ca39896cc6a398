"""Resources about roads: where they run, what drives on them, where work on them pays, and what a drive costs.

Parameters are those of the map server's own queries, and are checked as there; times may be ISO 8601 too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from starlette.responses import Response

from protocol.queries.answers import MapVersion
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES
from sitegrid.web import features
from sitegrid.web.encoding import as_json
from sitegrid.web.resource import AS_OF, BOUNDS, GEOJSON, Resource, as_geojson, of_version, parsed, version_of
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters

TIMES = ("from", "to", "as_of")
ROADS = {"from": "traffic of the hours that begin from then on", "to": "and before then", **AS_OF, **BOUNDS}
ROADS |= {"machine": "traffic of this one alone, and what it measured"}
WORK = {
    "target": "rolling resistance of good ground, above 0 and at most 1 (default 0.02)",
    "efficiency": "of engine and drive train, above 0 and at most 1 (default 0.35)",
    "limit": "rows, 1 to 1000 (default 100)",
    **ROADS,
}
DRIVE = {
    "machine": f"kind, for all that is not given: {', '.join(MACHINES)}",
    "mass": "with what it carries [kg]",
    "speed": "highest [m/s]",
    "power": "at the wheels [W]",
    "efficiency": "energy at the wheels over that of the fuel",
    "accelerate": "as it is driven [m/s2]",
    "brake": "likewise [m/s2]",
    "lateral": "sideways in curves [m/s2]",
    "rotating": "mass with what rotates with it over mass",
    "stops": "begin, end, begin,end or none",
    "step": "length of the steps that are answered [m]",
    "unknown": "ground that nobody knows: dearest, refuse or a resistance",
    "repairs": "1: roads whose ground changed, from the samples since (default); 0: from all samples",
    **AS_OF,
}
ROUTE = {"line": "x,y;x,y;... [m], two places or more", **DRIVE}
CHEAPEST = {
    "from": "x,y [m]",
    "to": "x,y [m]",
    "cost": "energy or time",
    "max_grade": "steepest ground that it leads over",
    "margin": "so far it stays from what it may not lead over, and from `avoid` [m]",
    "avoid": "x,y;x,y;... [m], as parked machines",
    **DRIVE,
}


async def segments(feed: SiteFeed, parameters: Parameters) -> Response:
    """Roads, segment by segment."""
    answer = await _segments(feed, parameters)
    return _of_map(await as_json(answer), answer)


async def segment_features(feed: SiteFeed, parameters: Parameters) -> Response:
    """Roads as lines."""
    answer = await _segments(feed, parameters)
    return _of_map(await as_geojson(features.segments, answer.segments, await feed.projection()), answer)


async def worklist(feed: SiteFeed, parameters: Parameters) -> Response:
    """Stretches where work pays."""
    answer = await _worklist(feed, parameters)
    return _of_map(await as_json(answer), answer)


async def worklist_features(feed: SiteFeed, parameters: Parameters) -> Response:
    """Stretches where work pays, as lines."""
    answer = await _worklist(feed, parameters)
    return _of_map(await as_geojson(features.worklist, answer.rows, await feed.projection()), answer)


async def repair_features(feed: SiteFeed, parameters: Parameters) -> Response:
    """Stretches whose ground changed, as lines."""
    answer = await _worklist(feed, parameters)
    return _of_map(await as_geojson(features.repairs, answer.changes, await feed.projection()), answer)


async def route(feed: SiteFeed, parameters: Parameters) -> Response:
    """What a drive along a line costs a machine."""
    return await _drive(feed, "route", parameters, places=("line",))


async def cheapest(feed: SiteFeed, parameters: Parameters) -> Response:
    """The line that costs a machine least, and what it costs."""
    return await _drive(feed, "way", parameters, places=("from", "to", "avoid"))


RESOURCES: dict[str, Resource] = {
    "segments": Resource(segments, "Roads, and what drives on them", ROADS, follows_now=True),
    "worklist": Resource(worklist, "Stretches of road where work pays", WORK, follows_now=True),
    "features/segments": Resource(segment_features, "Roads as lines", ROADS, GEOJSON, follows_now=True),
    "features/worklist": Resource(worklist_features, "The worklist as lines", WORK, GEOJSON, follows_now=True),
    "features/repairs": Resource(
        repair_features,
        "Stretches that were repaired or became worse, as lines",
        {name: text for name, text in WORK.items() if name not in ("limit", "efficiency")},
        GEOJSON,
        follows_now=True,
    ),
    "route": Resource(route, "What a drive along a line costs a machine", ROUTE),
    "way": Resource(cheapest, "The line between two places that costs a machine least", CHEAPEST),
}


async def _segments(feed: SiteFeed, parameters: Parameters) -> Segments:
    query = parsed("segments", parameters, TIMES)
    assert isinstance(query, SegmentsQuery)
    return await feed.ask_for_much(feed.client.segments, **_named(query))


async def _worklist(feed: SiteFeed, parameters: Parameters) -> Worklist:
    query = parsed("worklist", parameters, TIMES)
    assert isinstance(query, WorklistQuery)
    return await feed.ask_for_much(feed.client.worklist, **_named(query))


async def _drive(feed: SiteFeed, name: str, parameters: Parameters, places: Sequence[str]) -> Response:
    query = parsed(name, parameters, places=places)
    assert isinstance(query, RouteQuery | WayQuery)
    answer = await feed.ask_for_much(feed.client.drive, query)
    totals = {**asdict(answer.totals), "litres": answer.totals.litres}
    ground = {"line": answer.line_m, "totals": totals, "steps": vars(answer.steps), "machine": asdict(answer.machine)}
    table = {**ground, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


def _of_map(response: Response, answer: Segments | Worklist) -> Response:
    return of_version(response, MapVersion(answer.store, answer.merged, answer.fact))


def _named(query: SegmentsQuery | WorklistQuery) -> dict[str, Any]:
    """A query as the client's method takes it; the web server waits for no row."""
    return {name: value for name, value in vars(query).items() if name != "fresh"}
