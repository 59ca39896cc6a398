"""Request parameters to checked values, values to JSON; errors are problem details (RFC 9457) with protocol reasons."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime, timedelta
from http import HTTPStatus
from typing import Any

import numpy as np
from starlette.responses import Response

from protocol.errors import LinkError, QueryError, Refusal, SitegridError
from protocol.machine.readings import MAX_STAMP_NS
from sitegrid.times import iso

Parameters = Mapping[str, str]
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# HTTP status by protocol reason; others are client errors.
STATUS: dict[str, HTTPStatus] = {
    Refusal.UNKNOWN_QUERY: HTTPStatus.NOT_FOUND,
    Refusal.UNKNOWN_MACHINE: HTTPStatus.NOT_FOUND,
    Refusal.TOO_LARGE: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    Refusal.OVERLOADED: HTTPStatus.SERVICE_UNAVAILABLE,
    Refusal.STORE: HTTPStatus.SERVICE_UNAVAILABLE,
    Refusal.AFTER_TIMEOUT: HTTPStatus.GATEWAY_TIMEOUT,
}


def stamp(parameters: Parameters, name: str) -> int | None:
    """A time as a stamp [ns]: ISO 8601 (default zone UTC) or nanoseconds; None if missing."""
    text = parameters.get(name)
    if text is None:
        return None
    if text.isascii() and text.isdigit() and len(text) <= len(str(MAX_STAMP_NS)):
        stamp_ns = int(text)
    else:
        try:
            moment = datetime.fromisoformat(text)
        except ValueError:
            problem = f"parameter `{name}`: {text[:40]!r} is neither ISO 8601 nor nanoseconds"
            raise bad(Refusal.WRONG_TYPE, problem) from None
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        stamp_ns = (moment - _EPOCH) // timedelta(microseconds=1) * 1000
    if not 1 <= stamp_ns <= MAX_STAMP_NS:
        raise bad(Refusal.OUT_OF_RANGE, f"parameter `{name}`: {text[:40]} is no time from 1970 on")
    return stamp_ns


def check_known(parameters: Parameters, known: tuple[str, ...]) -> None:
    """Refuse unknown parameters."""
    if unknown := sorted(set(parameters) - set(known)):
        takes = ", ".join(known) or "none"
        raise bad(Refusal.UNKNOWN_PARAMETER, f"parameter `{unknown[0][:40]}` is not known; known: {takes}")


def plain(value: Any) -> Any:
    """Records as tables, arrays as lists, NaN as None for JSON; stamps get a time beside them."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f" and not (known := np.isfinite(value)).all():
            value = value.astype(object)
            value[~known] = None
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in with_times(value).items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def with_times(table: Mapping[Any, Any]) -> dict[Any, Any]:
    """Add a time beside each stamp."""
    times = {f"{key.removesuffix('_ns')}_time": iso(item) for key, item in table.items() if _is_stamp(key, item)}
    return {**table, **times}


def _is_stamp(key: object, value: object) -> bool:
    return isinstance(key, str) and key.endswith("_ns") and type(value) is int


class RequestProblem(SitegridError):  # noqa: N818 - the word of RFC 9457
    """A refused or failed request. reason: a word for programs, as in the protocol."""

    def __init__(self, status: HTTPStatus, reason: str, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.reason, self.headers = status, reason, headers or {}


def bad(reason: Refusal, detail: str) -> RequestProblem:
    """A client error."""
    return RequestProblem(STATUS.get(reason, HTTPStatus.BAD_REQUEST), reason, detail)


def problem_of(error: Exception) -> RequestProblem:
    """An error as a problem; unexpected ones reveal nothing."""
    if isinstance(error, RequestProblem):
        return error
    if isinstance(error, QueryError):
        status = STATUS.get(error.reason, HTTPStatus.BAD_REQUEST)
        headers = {"Retry-After": "1"} if status == HTTPStatus.SERVICE_UNAVAILABLE else {}
        return RequestProblem(status, error.reason, str(error), headers)
    if isinstance(error, LinkError):
        detail = "no map server answers for this site; start one with `sitegrid server`"
        return RequestProblem(HTTPStatus.SERVICE_UNAVAILABLE, "no_server", detail, {"Retry-After": "2"})
    if isinstance(error, SitegridError):
        return RequestProblem(HTTPStatus.BAD_GATEWAY, "bad_answer", "the map server's answer cannot be read")
    return RequestProblem(HTTPStatus.INTERNAL_SERVER_ERROR, "internal", "the web server failed; its log has more")


def problem_response(error: Exception) -> Response:
    """The response to a failed request."""
    problem = problem_of(error)
    body: dict[str, Any] = {
        "type": "about:blank",
        "title": problem.status.phrase,
        "status": int(problem.status),
        "detail": str(problem),
        "reason": str(problem.reason),
    }
    return Response(json.dumps(body), problem.status, problem.headers, "application/problem+json")
