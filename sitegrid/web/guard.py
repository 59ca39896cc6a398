"""Access checks before any work: names, tokens, origins, limits, headers."""

from __future__ import annotations

import re
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sitegrid.web.values import RequestProblem, problem_response

COOKIE = "sitegrid"
RATE_HZ, BURST = 100.0, 500.0  # requests per address: a GIS asks for hundreds of tiles per move
ADDRESSES = 4096  # known rates; the longest silent address is forgotten first
MAX_PATH, MAX_QUERY = 1024, 32_768  # bytes of path and parameters: a polygon of 1000 corners
OPEN_PATHS = ("/healthz",)  # reveal nothing of a site; monitoring has no token, and uses any name
_HOST = re.compile(r"(\[[^][]*\]|[^][:@/?#]*)(:\d*)?")  # Host header: name or address, and port
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; img-src 'self' data: blob:"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}


class Guard:
    """Middleware. person: a token's person or None; without it everybody is admitted.

    counts: requests and refusals, of sockets too. names: of this server, lower case. pictures: where pages may load
    pictures from, besides here.
    """

    def __init__(
        self,
        app: ASGIApp,
        person: Callable[[str], str | None] | None,
        counts: Counter[str],
        names: Collection[str],
        pictures: Iterable[str] = (),
    ) -> None:
        headers = {**HEADERS, "Content-Security-Policy": " ".join([POLICY, *pictures])}
        self._headers = [(name.lower().encode(), value.encode()) for name, value in headers.items()]
        self._app, self._person, self._names = app, person, frozenset(names) | {"localhost"}
        self._rates: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self.counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve or refuse one request or connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        self.counts["requests"] += 1
        try:
            self._check(scope)
        except RequestProblem as problem:
            self.counts[f"refused_{problem.reason}"] += 1
            await self._refuse(problem, scope, receive, send)
            return
        if scope["type"] == "http" and (redirect := self._without_token(scope)):
            await redirect(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.counts[f"status_{message['status']}"] += 1
                message.setdefault("headers", []).extend(self._headers)
            await send(message)

        await self._app(scope, receive, guarded)

    def _check(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        if len(scope["raw_path"]) > MAX_PATH or len(scope["query_string"]) > MAX_QUERY:
            detail = f"more than {MAX_PATH} bytes of path, or {MAX_QUERY} of parameters; ask for less"
            raise RequestProblem(HTTPStatus.REQUEST_URI_TOO_LONG, "too_large", detail)
        _check_body(headers)
        if scope["path"] not in OPEN_PATHS:
            self._check_host(headers)
        self._count_rate(scope)
        if self._person and scope["path"] not in OPEN_PATHS:
            person, token = self._person, _token(scope, headers)
            scope["may_stay"] = lambda: person(token) is not None
        if not scope.get("may_stay", _always)():
            detail = "a visitor's token is needed: ask the office for one, and open the link with it"
            raise RequestProblem(HTTPStatus.UNAUTHORIZED, "no_permission", detail, {"WWW-Authenticate": "Bearer"})

    def _check_host(self, headers: Headers) -> None:
        """Refuse foreign pages and DNS rebinding."""
        host = headers.get("host", "")
        parts = _HOST.fullmatch(host)
        name = parts[1].lower().rstrip(".") if parts else host
        if host and name not in self._names and not (parts and _is_address(name.strip("[]"))):
            detail = f"`{name[:80]}` is no name of this server: open it by its address, or start it with --host NAME"
            raise RequestProblem(HTTPStatus.MISDIRECTED_REQUEST, "wrong_host", detail)
        if (origin := headers.get("origin")) and _place_of(origin) != host:
            raise RequestProblem(HTTPStatus.FORBIDDEN, "wrong_origin", "a page of another address may not ask here")

    def _count_rate(self, scope: Scope) -> None:
        """Token bucket of BURST, refilled at RATE_HZ."""
        address = scope["client"][0] if scope.get("client") else ""
        now_s = time.monotonic()
        level, seen_s = self._rates.pop(address, (BURST, now_s))
        level = min(BURST, level + (now_s - seen_s) * RATE_HZ) - 1
        self._rates[address] = max(0.0, level), now_s
        if len(self._rates) > ADDRESSES:
            self._rates.popitem(last=False)
        if level < 0:
            raise RequestProblem(
                HTTPStatus.TOO_MANY_REQUESTS, "too_many", "too many requests; wait", {"Retry-After": "1"}
            )

    def _without_token(self, scope: Scope) -> RedirectResponse | None:
        """Exchange a page's token for a cookie, so that it stays out of histories."""
        parameters = parse_qsl(scope["query_string"].decode("latin-1"))
        token = dict(parameters).get("token")
        if not self._person or not token or scope["path"] != "/":
            return None
        rest = urlencode([(name, value) for name, value in parameters if name != "token"])
        response = RedirectResponse(f"/?{rest}" if rest else "/", HTTPStatus.SEE_OTHER)
        response.set_cookie(COOKIE, token, httponly=True, samesite="strict", secure=scope["scheme"] == "https")
        return response

    async def _refuse(self, problem: RequestProblem, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            await problem_response(problem)(scope, receive, send)
            return
        await receive()  # the connection's first message
        await send({"type": "websocket.accept"})
        code = 4401 if problem.status == HTTPStatus.UNAUTHORIZED else 4403
        await send({"type": "websocket.close", "code": code, "reason": problem.reason})


def _check_body(headers: Headers) -> None:
    """Refuse a body and close: another parser may see its end elsewhere, and a smuggled request in it."""
    if "content-length" in headers and "transfer-encoding" in headers:
        detail = "the request states its length twice (Content-Length, Transfer-Encoding); send neither"
        raise RequestProblem(HTTPStatus.BAD_REQUEST, "two_lengths", detail, {"Connection": "close"})
    if headers.get("content-length", "0") not in ("", "0") or "transfer-encoding" in headers:
        detail = "no body is taken"
        raise RequestProblem(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too_large", detail, {"Connection": "close"})


def _is_address(text: str) -> bool:
    try:
        return bool(ip_address(text))
    except ValueError:
        return False


def _place_of(origin: str) -> str:
    """Host and port of an Origin, empty if invalid."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _always() -> bool:
    return True


def _token(scope: Scope, headers: Headers) -> str:
    """A request's token: header, cookie, or address for tools that have nothing else."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer" and token:
        return token.strip()
    parameters: dict[str, Any] = dict(parse_qsl(scope["query_string"].decode("latin-1")))
    if "token" in parameters:
        return str(parameters["token"])
    try:
        cookie: SimpleCookie = SimpleCookie(headers.get("cookie", ""))
    except CookieError:
        return ""
    return cookie[COOKIE].value if COOKIE in cookie else ""
