"""Who may come in, and how much: names, tokens, origins, limits and headers, before anything is worked on."""

from __future__ import annotations

import re
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection
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
RATE_HZ, BURST = 100.0, 500.0  # requests of one address: a GIS asks for some hundred tiles when its view moves
ADDRESSES = 4096  # whose rate is known; the one that was silent longest is forgotten first
MAX_PATH, MAX_QUERY = 1024, 32_768  # bytes of a path, and of parameters: a polygon of 1000 corners
OPEN_PATHS = ("/healthz",)  # says nothing of a site; who watches a server asks without a token, by any name
_HOST = re.compile(r"(\[[^][]*\]|[^][:@/?#]*)(:\d*)?")  # a Host header: a name or address, and a port
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
}


class Guard:
    """Middleware. person: whose token it is, None for nobody's; without it everybody may come in.

    counts: of what came in and what was refused, sockets among it. names: of this server, in lower case.
    """

    def __init__(
        self, app: ASGIApp, person: Callable[[str], str | None] | None, counts: Counter[str], names: Collection[str]
    ) -> None:
        self._app, self._person, self._names = app, person, frozenset(names) | {"localhost"}
        self._rates: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self.counts = counts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request or connection, or refuse it."""
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
                headers = message.setdefault("headers", [])
                headers += [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
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
        """Refuse pages of others, and a page whose own name was made to lead here (DNS rebinding)."""
        host = headers.get("host", "")
        parts = _HOST.fullmatch(host)
        name = parts[1].lower().rstrip(".") if parts else host
        if host and name not in self._names and not (parts and _is_address(name.strip("[]"))):
            detail = f"`{name[:80]}` is no name of this server: open it by its address, or start it with --host NAME"
            raise RequestProblem(HTTPStatus.MISDIRECTED_REQUEST, "wrong_host", detail)
        if (origin := headers.get("origin")) and _place_of(origin) != host:
            raise RequestProblem(HTTPStatus.FORBIDDEN, "wrong_origin", "a page of another address may not ask here")

    def _count_rate(self, scope: Scope) -> None:
        """A bucket of BURST that fills with RATE_HZ."""
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
        """A page that was opened with its token goes on with a cookie, so that the token stays in no history."""
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
    """Refuse a body, and end its connection: another reader may see its end elsewhere, and a second request in it."""
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
    """Host and port of an Origin; empty where it is none."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _always() -> bool:
    return True


def _token(scope: Scope, headers: Headers) -> str:
    """The token of a request: in its header, its cookie, or its address, for tools that know addresses alone."""
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
