"""Errors of the API as problem details (RFC 9457), with the reasons of the protocol."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import Any

from starlette.responses import Response

from protocol.errors import LinkError, QueryError, Refusal, SitegridError

# What a reason of the protocol is over HTTP; any other one is the asker's mistake.
STATUS: dict[str, HTTPStatus] = {
    Refusal.UNKNOWN_QUERY: HTTPStatus.NOT_FOUND,
    Refusal.UNKNOWN_MACHINE: HTTPStatus.NOT_FOUND,
    Refusal.TOO_LARGE: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    Refusal.OVERLOADED: HTTPStatus.SERVICE_UNAVAILABLE,
    Refusal.STORE: HTTPStatus.SERVICE_UNAVAILABLE,
    Refusal.AFTER_TIMEOUT: HTTPStatus.GATEWAY_TIMEOUT,
}


class Problem(SitegridError):  # noqa: N818 - the word of RFC 9457
    """A request that is refused, or that cannot be answered. reason: a word for programs, as in the protocol."""

    def __init__(self, status: HTTPStatus, reason: str, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.reason, self.headers = status, reason, headers or {}


def bad(reason: Refusal, detail: str) -> Problem:
    """A request that says something wrong."""
    return Problem(STATUS.get(reason, HTTPStatus.BAD_REQUEST), reason, detail)


def problem_of(error: Exception) -> Problem:
    """An error as a problem; one that nobody expected says no more than that it was one."""
    if isinstance(error, Problem):
        return error
    if isinstance(error, QueryError):
        status = STATUS.get(error.reason, HTTPStatus.BAD_REQUEST)
        headers = {"Retry-After": "1"} if status == HTTPStatus.SERVICE_UNAVAILABLE else {}
        return Problem(status, error.reason, str(error), headers)
    if isinstance(error, LinkError):
        detail = "no map server answers for this site; start one with `sitegrid server`"
        return Problem(HTTPStatus.SERVICE_UNAVAILABLE, "no_server", detail, {"Retry-After": "2"})
    if isinstance(error, SitegridError):
        return Problem(HTTPStatus.BAD_GATEWAY, "bad_answer", "the map server's answer cannot be read")
    return Problem(HTTPStatus.INTERNAL_SERVER_ERROR, "internal", "the web server failed; its log has more")


def problem_response(error: Exception) -> Response:
    """The answer to a request that failed."""
    problem = problem_of(error)
    body: dict[str, Any] = {
        "type": "about:blank",
        "title": problem.status.phrase,
        "status": int(problem.status),
        "detail": str(problem),
        "reason": str(problem.reason),
    }
    return Response(json.dumps(body), problem.status, problem.headers, "application/problem+json")
