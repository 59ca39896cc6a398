"""Roads as features: where they run, where work on them pays, what was repaired; and what a drive costs."""

from __future__ import annotations

from dataclasses import asdict

from starlette.responses import Response

from protocol.queries.answers import MapVersion
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery
from protocol.queries.route_requests import LineQuery, RouteQuery, WayQuery
from sitegrid.web import features
from sitegrid.web.encoding import as_json
from sitegrid.web.resource import GEOJSON, Resource, as_geojson, of_version, version_of
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters


async def segment_features(feed: SiteFeed, query: SegmentsQuery, _: Parameters) -> Response:
    """Roads as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_geojson(features.segments, answer.segments, await feed.projection()), answer)


async def worklist_features(feed: SiteFeed, query: WorklistQuery, _: Parameters) -> Response:
    """Stretches where work pays, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_geojson(features.worklist, answer.rows, await feed.projection()), answer)


async def repair_features(feed: SiteFeed, query: WorklistQuery, _: Parameters) -> Response:
    """Stretches whose ground changed, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_geojson(features.repairs, answer.changes, await feed.projection()), answer)


async def drive(feed: SiteFeed, query: LineQuery, _: Parameters) -> Response:
    """What a drive costs a machine, along a line that is given or that costs least."""
    answer = await feed.answer_to(query)
    totals = {**asdict(answer.totals), "litres": answer.totals.litres}
    ground = {"line": answer.line_m, "totals": totals, "steps": vars(answer.steps), "machine": asdict(answer.machine)}
    table = {**ground, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


REPAIRS = "Stretches that were repaired or became worse, as lines"
RESOURCES: dict[str, Resource] = {
    "features/segments": Resource(segment_features, "Roads as lines", SegmentsQuery, media=GEOJSON, follows_now=True),
    "features/worklist": Resource(
        worklist_features, "The worklist as lines", WorklistQuery, media=GEOJSON, follows_now=True
    ),
    "features/repairs": Resource(
        repair_features, REPAIRS, WorklistQuery, ("limit", "efficiency"), media=GEOJSON, follows_now=True
    ),
    "route": Resource(drive, RouteQuery.help, RouteQuery),
    "way": Resource(drive, WayQuery.help, WayQuery),
}


def _of_map(response: Response, answer: Segments | Worklist) -> Response:
    return of_version(response, MapVersion(answer.store, answer.merged, answer.fact))
