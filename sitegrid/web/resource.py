"""API resources, their common parameters, and JSON answers."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from protocol.errors import Refusal
from protocol.queries.answers import MapVersion
from protocol.queries.parameters import ValueForm, name_of, number, text_of
from protocol.queries.request import Fresh, MapQuery, Parameter, parameters_of
from protocol.queries.requests import parse_query
from sitegrid.features.feature import Collection, geojson
from sitegrid.web import values
from sitegrid.web.encoding import answered, as_json
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters

Answer = Callable[[SiteFeed, Any, Parameters], Awaitable[Response]]
LAT_LON = (
    Parameter("lat", "latitude [deg], with lon in place of x and y", number(-90.0, 90.0)),
    Parameter("lon", "longitude [deg]", number(-360.0, 360.0)),  # some programs count beyond 180
)
FEATURE_FORMAT = Parameter("format", "geojson, or fgb: FlatGeobuf", name_of())
FEATURE_MEDIA = {"geojson": "application/geo+json", "fgb": "application/flatgeobuf"}


@dataclass(frozen=True)
class Resource:
    """A path's answer: from a query to the map server, or from the web server.

    query: its parameters apply, except `without` and those for waiting. more: further parameters, passed to `answer`.
    media: possible types. follows_now: depends on the site's now, not on the map alone.
    """

    answer: Answer
    summary: str
    query: type[MapQuery[Any]] | None = None
    without: tuple[str, ...] = ()
    more: tuple[Parameter, ...] = ()
    media: tuple[str, ...] = ("application/json",)
    follows_now: bool = False

    @property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters by name."""
        known = parameters_of(self.query) if self.query else {}
        waits = parameters_of(Fresh) if self.query and issubclass(self.query, Fresh) else {}
        taken = {name: one for name, one in known.items() if name not in self.without and name not in waits}
        places = LAT_LON if "x" in taken else ()
        return taken | {one.name: one for one in (*places, *self.more)}

    async def answered(self, feed: SiteFeed, parameters: Parameters) -> Response:
        """Answer known parameters; QueryError or Problem names a wrong one."""
        more = {one.name for one in self.more}
        rest = {name: text for name, text in parameters.items() if name in more}
        if self.query is None:
            return await self.answer(feed, None, rest)
        asked = {name: text for name, text in parameters.items() if name not in more}
        if "lat" in self.parameters:
            asked = await _in_metres(feed, asked)
        return await self.answer(feed, _parsed(self.query, asked), rest)


async def _in_metres(feed: SiteFeed, asked: dict[str, str]) -> dict[str, str]:
    """Replace latitude and longitude by a place in `map` [m]."""
    if not {"lat", "lon"} & set(asked):
        return asked
    degrees = [one.read(asked) for one in LAT_LON]
    for one, value in zip(LAT_LON, degrees, strict=True):
        one.check(value)
    x_m, y_m, _ = (await feed.projection()).to_map(degrees[0], degrees[1], 0.0)
    if not (math.isfinite(x_m) and math.isfinite(y_m)):
        raise values.bad(Refusal.OUT_OF_RANGE, "`lat`, `lon`: too far from the site")
    rest = {name: text for name, text in asked.items() if name not in ("x", "y", "lat", "lon")}
    return {**rest, "x": text_of(x_m), "y": text_of(y_m)}


def _parsed(query: type[MapQuery[Any]], parameters: Parameters) -> MapQuery[Any]:
    """A query, checked as by the map server; also takes ISO 8601 times and places x,y;x,y;..."""
    texts = dict(parameters)
    for name, one in parameters_of(query).items():
        if name in texts and one.kind.form is ValueForm.STAMP:
            texts[name] = str(values.stamp(parameters, name))
        elif name in texts and one.kind.form in (ValueForm.PLACE, ValueForm.PLACES):
            texts[name] = texts[name].replace(";", ",")
    return parse_query(query.name, texts)


def of_features(
    answer: Answer,
    summary: str,
    query: type[MapQuery[Any]] | None = None,
    without: tuple[str, ...] = (),
    *,
    follows_now: bool = True,
) -> Resource:
    """A resource that answers with features."""
    return Resource(answer, summary, query, without, (FEATURE_FORMAT,), tuple(FEATURE_MEDIA.values()), follows_now)


async def as_features(feed: SiteFeed, more: Parameters, name: str, collection: Collection) -> Response:
    """Features in the requested format. name: of their layer."""
    kind = more.get(FEATURE_FORMAT.name, "geojson")
    if kind not in FEATURE_MEDIA:
        raise values.bad(Refusal.OUT_OF_RANGE, f"parameter `{FEATURE_FORMAT.name}`: {FEATURE_FORMAT.help}")
    projection = await feed.projection()
    if kind == "fgb":
        try:
            from sitegrid.features.gdal import flat_geobuf  # 110 MB, which the page does not need
        except ModuleNotFoundError:
            problem = f"parameter `{FEATURE_FORMAT.name}`: fgb needs pip install '.[export]' where the web server runs"
            raise values.bad(Refusal.OUT_OF_RANGE, f"{problem}; geojson needs nothing") from None
        return await answered(flat_geobuf(collection, projection, name), FEATURE_MEDIA[kind])
    return await as_json(geojson(collection, projection), FEATURE_MEDIA[kind])


def of_version(response: Response, version: MapVersion) -> Response:
    """Tag an answer with its map: roads may lag by seconds, so a copy may not be current."""
    response.headers["ETag"] = tag_of(version)
    return response


def tag_of(version: MapVersion) -> str:
    """ETag of answers that depend on the map alone."""
    return f'"{version.store}-{version.row}-{version.fact}"'


def has_copy(request: Request, tag: str) -> bool:
    """Whether the client has this tag: If-None-Match takes lists, * and weak tags (RFC 9110 13.1.2)."""
    text = ",".join(request.headers.getlist("if-none-match")).strip()
    return text == "*" or tag in [part.strip().removeprefix("W/") for part in text.split(",")]


def version_of(version: MapVersion) -> dict[str, Any]:
    """An answer's map version, named as everywhere."""
    return {"store": version.store, "merged": version.row, "fact": version.fact}
