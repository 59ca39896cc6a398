"""The web server as ASGI application: routes to resources, pages, tiles, live connections."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections import Counter
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from protocol.errors import Refusal
from protocol.queries.answers import MapInfo, MapVersion
from protocol.queries.requests import RegionQuery
from protocol.site.geometry import Bounds
from sitegrid.web import live, values
from sitegrid.web.backdrop import Backdrop
from sitegrid.web.encoding import Cache, as_json, beside
from sitegrid.web.guard import Guard
from sitegrid.web.openapi import PREFIX, description
from sitegrid.web.resource import has_copy, tag_of
from sitegrid.web.resources import RESOURCES, follows_now
from sitegrid.web.site import SiteFeed
from sitegrid.web.values import RequestProblem, bad, problem_response
from sitegrid.web.xyz import mercator, overview

PAGE = Path(__file__).parent / "page"
FRESH_S = 1.0  # maximum age of the version used for tiles and cached copies
PNG_BYTES = 2**25  # tile cache: about 4000 tiles
SMALL_ALREADY = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/octet-stream", "application/x-npz")  # already compressed
MARGIN_M = 100.0  # around the bounds of folded samples: tiles show samples that wait for the fold
log = logging.getLogger("sitegrid.web")


class WebApp:
    """All sites and their routes. backdrops: by site. person, counts, names: see Guard."""

    def __init__(
        self,
        feeds: Sequence[SiteFeed],
        person: Callable[[str], str | None] | None,
        counts: Counter[str],
        names: Collection[str],
        backdrops: Mapping[str, Backdrop],
    ) -> None:
        self._feeds = {feed.name: feed for feed in feeds}
        self._backdrops = {name: backdrops.get(name, Backdrop()) for name in self._feeds}
        self._pngs: Cache[bytes] = Cache(PNG_BYTES, len)
        site = f"{PREFIX}/sites/{{site}}"
        routes = [
            Route(f"{PREFIX}/sites", self._sites),
            Route(f"{PREFIX}/openapi.json", self._openapi),
            *(Route(f"{site}/{name}", self._resource, name=name) for name in RESOURCES),
            WebSocketRoute(f"{site}/live", self._live),
            Route(f"{site}/backdrop", self._backdrop),
            Route(f"{site}/base_map", self._base_map),
            Route(f"{site}/xyz/{{layer}}.json", self._tilejson),
            Route(f"{site}/xyz/{{kind}}/{{layer}}/{{z:int}}/{{x:int}}/{{y:int}}.png", self._xyz),
            Route("/healthz", self._healthz),
            Route("/metrics", self._metrics),
            Mount("/", StaticFiles(directory=PAGE, html=True)),
        ]
        handlers: dict[Any, Any] = {HTTPException: _not_there, Exception: _failed}
        app = Starlette(routes=routes, exception_handlers=handlers, lifespan=self._lifespan)
        app.add_middleware(GZipMiddleware, minimum_size=1000, compresslevel=5, exclude_content_types=SMALL_ALREADY)
        sources = sorted({one.source for one in self._backdrops.values() if one.source})
        self.guard = Guard(app, person, counts, names, sources)
        self.app: ASGIApp = self.guard

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        yield
        await asyncio.gather(*(feed.close() for feed in self._feeds.values()))

    def _feed(self, request: Request | WebSocket) -> SiteFeed:
        name = request.path_params["site"]
        if name not in self._feeds:
            known = ", ".join(self._feeds)
            raise RequestProblem(
                HTTPStatus.NOT_FOUND, "unknown_site", f"site `{name[:40]}` is not here; known: {known}"
            )
        return self._feeds[name]

    async def _sites(self, _: Request) -> Response:
        return _json({"sites": [{"name": name, "href": f"{PREFIX}/sites/{name}/info"} for name in self._feeds]})

    async def _openapi(self, _: Request) -> Response:
        return await as_json(description())

    async def _resource(self, request: Request) -> Response:
        """One resource; 304 if the client's copy is of the current map."""
        name = request.url.path.split("/", 5)[5]
        resource, parameters = RESOURCES[name], _parameters(request)
        try:
            feed = self._feed(request)
            values.check_known(parameters, tuple(resource.parameters))
            info = await feed.info(FRESH_S)
            tag = _tag(info, with_now=follows_now(resource, parameters))
            headers = {"ETag": tag, "Cache-Control": "private, no-cache", "Vary": "Accept-Encoding"}
            if has_copy(request, tag):
                return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
            response = await resource.answered(feed, parameters)
        except Exception as error:  # any error becomes a problem response
            return _failed(request, error)
        own = response.headers.get("etag")
        response.headers.update(headers if own in (None, _tag(info, with_now=False)) else {**headers, "ETag": str(own)})
        return response

    async def _live(self, socket: WebSocket) -> None:
        if socket.path_params["site"] not in self._feeds:
            await socket.accept()
            await socket.close(4404, "unknown site")
            return
        await live.serve(socket, self._feed(socket))

    async def _backdrop(self, request: Request) -> Response:
        """What the page draws beneath the map."""
        try:
            feed = self._feed(request)
            info, projection = await feed.info(), await feed.projection()
            picture = f"{PREFIX}/sites/{feed.name}/base_map"
            return _json(self._backdrops[feed.name].described(info.site, projection, picture))
        except Exception as error:
            return _failed(request, error)

    async def _base_map(self, request: Request) -> Response:
        """The base map's picture."""
        backdrop = self._backdrops.get(request.path_params["site"], Backdrop())
        if backdrop.has_tiles or not backdrop.base_map:
            return _not_there(request, HTTPException(HTTPStatus.NOT_FOUND))
        return FileResponse(backdrop.base_map)

    async def _tilejson(self, request: Request) -> Response:
        """TileJSON of a layer, as colours or values."""
        try:
            feed, layer = self._feed(request), request.path_params["layer"]
            kind = _parameters(request).get("kind", "colour")
            info = await feed.info(FRESH_S)
            _check_layer(kind, layer, info)
            token = request.query_params.get("token")  # clients that only send addresses need it in these too
            end = f"?{urlencode({'token': token})}" if token else ""
            base = f"{request.url.scheme}://{request.url.netloc}{PREFIX}/sites/{feed.name}/xyz/{kind}/{layer}"
            table: dict[str, Any] = {
                "tilejson": "3.0.0",
                "name": f"{feed.name}: {layer}",
                "tiles": [f"{base}/{{z}}/{{x}}/{{y}}.png{end}"],
                "minzoom": 0,
                "maxzoom": mercator.MAX_ZOOM,
            }
            if info.bounds:
                table["bounds"] = await _geodetic_bounds(feed, info)
            if kind == "value":
                scale, offset = mercator.coding(layer)
                coding = "value = offset + scale * (65536 * red + 256 * green + blue); red = green = blue = 0: unknown"
                table |= {"encoding": coding, "scale": scale, "offset": offset, "unknown": 0}
            return _json(table, {"ETag": _tag(info, with_now=False), "Cache-Control": "private, no-cache"})
        except Exception as error:
            return _failed(request, error)

    async def _xyz(self, request: Request) -> Response:
        try:
            return await self._tile(request)
        except Exception as error:
            return _failed(request, error)

    async def _tile(self, request: Request) -> Response:
        path = request.path_params
        feed, kind, layer, z, x, y = self._feed(request), *(path[name] for name in ("kind", "layer", "z", "x", "y"))
        if not (z <= mercator.MAX_ZOOM and x < 2**z and y < 2**z):
            raise bad(Refusal.OUT_OF_RANGE, f"tile {z}/{x}/{y}: zooms 0 to {mercator.MAX_ZOOM}, x and y below 2^zoom")
        info = await feed.info(FRESH_S)
        _check_layer(kind, layer, info)
        tag = _tag(info, with_now=layer in ("age_s", "changed_s"))
        headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if has_copy(request, tag):
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
        key = (feed.name, kind, layer, z, x, y, tag)
        if (png := self._pngs.get(key)) is None:
            self._pngs.keep(key, png := await _png(feed, info, kind, layer, (z, x, y)))
        return Response(png, headers=headers, media_type="image/png")

    async def _healthz(self, _: Request) -> Response:
        """Liveness of the web server; map servers: /metrics."""
        return PlainTextResponse("ok\n")

    async def _metrics(self, _: Request) -> Response:
        lines = ["# TYPE sitegrid_web_total counter"]
        lines += [f'sitegrid_web_total{{event="{name}"}} {n}' for name, n in sorted(self.guard.counts.items())]
        feeds = self._feeds.values()
        for name, figures in (("pages", [d.watchers for d in feeds]), ("server_away", [int(d.is_away) for d in feeds])):
            lines.append(f"# TYPE sitegrid_web_{name} gauge")
            lines += [f'sitegrid_web_{name}{{site="{d.name}"}} {n}' for d, n in zip(feeds, figures, strict=True)]
        lines.append("# TYPE sitegrid_web_poses_refused_total counter")
        for feed in feeds:
            for reason, n in sorted(feed.refused.items()):
                lines.append(f'sitegrid_web_poses_refused_total{{site="{feed.name}",reason="{reason}"}} {n}')
        return PlainTextResponse("\n".join(lines) + "\n", media_type="text/plain; version=0.0.4")


async def _png(feed: SiteFeed, info: MapInfo, kind: str, layer: str, place: tuple[int, int, int]) -> bytes:
    """An XYZ tile of the map's cells."""
    cell_m, projection = info.site.cell_m, await feed.projection()
    png = mercator.value_png if kind == "value" else mercator.colour_png
    if mercator.pixel_m(place[0], info.site.origin_lat_deg) > overview.LEAST_CELLS * cell_m:
        tiles = await feed.known_tiles()
        values_px = await feed.ask_for_much(overview.draw, feed.client, tiles, layer, place, cell_m, projection)
        return await beside(png, values_px, layer)
    pixels = await beside(mercator.pixels_of, *place, projection)
    bounds = pixels.bounds(_known(info), cell_m) if info.merged else None
    if bounds is None:
        return mercator.empty_png(kind)
    region = await feed.ask(feed.client.ask, RegionQuery(bounds, (layer,)))
    edges = region.bounds
    return await beside(lambda: png(pixels.sample(region[layer], edges.west_m, edges.south_m, cell_m), layer))


def _known(info: MapInfo) -> Bounds:
    """Where the map may have values: the whole site until its blocks are counted."""
    if info.bounds is None:
        return Bounds(-info.site.extent_m, -info.site.extent_m, info.site.extent_m, info.site.extent_m)
    west, south, east, north = (edge * info.site.cell_m for edge in info.bounds)
    return Bounds(west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M)


async def _geodetic_bounds(feed: SiteFeed, info: MapInfo) -> list[float]:
    west, south, east, north = (edge * info.site.cell_m for edge in info.bounds or (0, 0, 0, 0))
    projection = await feed.projection()
    corners = [projection.to_geodetic(x, y) for x in (west, east) for y in (south, north)]
    lats, lons = [corner[0] for corner in corners], [corner[1] for corner in corners]
    if max(lons) - min(lons) > 180:  # a site on the 180th meridian: TileJSON has no rectangle across it
        lons = [-180.0, 180.0]
    return [min(lons), min(lats), max(lons), max(lats)]


def _check_layer(kind: str, layer: str, info: MapInfo) -> None:
    if kind not in ("colour", "value"):
        raise bad(Refusal.OUT_OF_RANGE, f"`{kind[:40]}` is neither colour nor value")
    if layer not in info.layers:
        problem = f"layer `{layer[:40]}` is not known; known: {', '.join(info.layers)}"
        raise RequestProblem(HTTPStatus.NOT_FOUND, Refusal.UNKNOWN_LAYER, problem)


def _parameters(request: Request) -> dict[str, str]:
    return {name: value for name, value in request.query_params.items() if name != "token"}


def _tag(info: MapInfo, *, with_now: bool) -> str:
    """Tag of an answer's map: store and version, and the site's now if ages depend on it."""
    tag = tag_of(MapVersion(info.store, info.merged, info.fact))
    return f'{tag[:-1]}-{info.stamp_ns}-{info.journalled}"' if with_now else tag


def _json(value: Any, headers: dict[str, str] | None = None) -> Response:
    return Response(json.dumps(value), headers=headers, media_type="application/json")


def _not_there(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    reason = "wrong_method" if status == HTTPStatus.METHOD_NOT_ALLOWED else "not_found"
    return problem_response(RequestProblem(status, reason, f"{status.phrase}; see {PREFIX}/openapi.json"))


def _failed(request: Request, error: Exception) -> Response:
    response = problem_response(error)
    if response.status_code == HTTPStatus.INTERNAL_SERVER_ERROR:
        log.error("failed path=%s", request.url.path, exc_info=error)
    return response
