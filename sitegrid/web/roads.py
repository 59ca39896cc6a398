"""Roads as features: where they run, where work on them pays, what was repaired; and what a drive costs."""

from __future__ import annotations

from dataclasses import asdict

from starlette.responses import Response

from protocol.queries.answers import MapVersion
from protocol.queries.roads import Segments, SegmentsQuery, Worklist, WorklistQuery
from protocol.queries.route_requests import LineQuery, RouteQuery, WayQuery
from sitegrid.features.feature import Collection
from sitegrid.features.kinds import REPAIR, SEGMENT, WORK
from sitegrid.web.encoding import as_json
from sitegrid.web.resource import Resource, as_features, of_features, of_version, version_of
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters


async def segment_features(feed: SiteFeed, query: SegmentsQuery, more: Parameters) -> Response:
    """Roads as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "segments", Collection(SEGMENT, answer.segments)), answer)


async def worklist_features(feed: SiteFeed, query: WorklistQuery, more: Parameters) -> Response:
    """Stretches where work pays, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "worklist", Collection(WORK, answer.rows)), answer)


async def repair_features(feed: SiteFeed, query: WorklistQuery, more: Parameters) -> Response:
    """Stretches whose ground changed, as lines."""
    answer = await feed.answer_to(query)
    return _of_map(await as_features(feed, more, "repairs", Collection(REPAIR, answer.changes)), answer)


async def drive(feed: SiteFeed, query: LineQuery, _: Parameters) -> Response:
    """What a drive costs a machine, along a line that is given or that costs least."""
    answer = await feed.answer_to(query)
    totals = {**asdict(answer.totals), "litres": answer.totals.litres}
    ground = {"line": answer.line_m, "totals": totals, "steps": vars(answer.steps), "machine": asdict(answer.machine)}
    table = {**ground, **version_of(answer.version), "stamp_ns": answer.stamp_ns}
    return of_version(await as_json(table), answer.version)


REPAIRS = "Stretches that were repaired or became worse, as lines"
RESOURCES: dict[str, Resource] = {
    "features/segments": of_features(segment_features, "Roads as lines", SegmentsQuery),
    "features/worklist": of_features(worklist_features, "The worklist as lines", WorklistQuery),
    "features/repairs": of_features(repair_features, REPAIRS, WorklistQuery, ("limit", "efficiency")),
    "route": Resource(drive, RouteQuery.help, RouteQuery),
    "way": Resource(drive, WayQuery.help, WayQuery),
}


def _of_map(response: Response, answer: Segments | Worklist) -> Response:
    return of_version(response, MapVersion(answer.store, answer.merged, answer.fact))
