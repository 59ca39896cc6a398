"""What a resource of the API is, what parameters several of them have in common, and how answers become JSON."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from protocol.queries import requests
from protocol.queries.answers import MapVersion
from sitegrid.web import values
from sitegrid.web.encoding import as_json, beside
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import Parameters

Answer = Callable[[SiteFeed, Parameters], Awaitable[Response]]

PLACE = {"x": "east of the site's origin [m]", "y": "north of it [m]"}
PLACE |= {"lat": "latitude [deg], with lon in place of x and y", "lon": "longitude [deg]"}
AS_OF = {"as_of": "the map as of this time, ISO 8601 or nanoseconds since 1970 (UTC)"}
LAYERS = {"layers": "names, comma-separated; without it all"}
BOUNDS = {"bounds": "west,south,east,north [m]"}
REPAIRS = {"repairs": "1: cells of roads whose ground changed, from the samples since (default 0)"}
WHEN = {**AS_OF, "minus": "less the map as of this time, value by value", **REPAIRS}
GEOJSON = ("application/geo+json",)


@dataclass(frozen=True)
class Resource:
    """What a path answers. parameters: name -> meaning. media: what it may answer with."""

    answer: Answer
    summary: str
    parameters: Mapping[str, str]
    media: tuple[str, ...] = ("application/json",)
    follows_now: bool = False  # whether it changes with the site's now, not with the map alone


async def as_geojson(make: Callable[..., Any], *arguments: Any) -> Response:
    """A collection of features, as `make` makes it of these arguments."""
    return await as_json(await beside(make, *arguments), GEOJSON[0])


def of_version(response: Response, version: MapVersion) -> Response:
    """Name the map that an answer is of: roads may be of some seconds ago, and a copy of them is none of the newest."""
    response.headers["ETag"] = tag_of(version)
    return response


def tag_of(version: MapVersion) -> str:
    """ETag of what follows from the map alone."""
    return f'"{version.store}-{version.row}-{version.fact}"'


def has_copy(request: Request, tag: str) -> bool:
    """Whether the asker has what this tag names: If-None-Match takes lists and *, and weak tags (RFC 9110 13.1.2)."""
    text = ",".join(request.headers.getlist("if-none-match")).strip()
    return text == "*" or tag in [part.strip().removeprefix("W/") for part in text.split(",")]


def version_of(version: MapVersion) -> dict[str, Any]:
    """The map that an answer is of, as all answers name it."""
    return {"store": version.store, "merged": version.row, "fact": version.fact}


def parsed(
    name: str, parameters: Parameters, times: Sequence[str] = ("as_of",), places: Sequence[str] = ()
) -> requests.MapQuery:
    """The map server's query of this name, checked as there. times may be ISO 8601, places x,y;x,y;... too."""
    stamps = {key: str(values.stamp(parameters, key)) for key in times if key in parameters}
    lines = {key: parameters[key].replace(";", ",") for key in places if key in parameters}
    return requests.parse_query(name, {**parameters, **stamps, **lines})
