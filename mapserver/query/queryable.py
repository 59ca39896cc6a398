"""Map queries as they come in over Zenoh: each waits for the row that it asks for, then for a thread, and is answered.

Callbacks only hand a query on: one that works stalls the session.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import zenoh

from mapserver.query.answer_pool import AnswerPool
from mapserver.query.answering import Answers
from mapserver.query.source import MapSource
from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import encode_error
from protocol.queries.origin import encode_origin
from protocol.queries.parameters import split_selector
from protocol.queries.places import PLACES_BYTES
from protocol.queries.requests import PointsQuery, RegionQuery, parse_query, reads_past
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.wire import keys

ANSWER_BYTES = 2**25  # of all answers that wait or are in work: 40 pieces, or 2000 points
MOST_PAST = 16  # that wait or are in work
MAX_QUESTION = 4096  # bytes of a query's parameters
WITH_PLACES = tuple(query.name for query in (PointsQuery, RegionQuery, RouteQuery, WayQuery))
ANSWERED = "queries_answered"  # a counter of `info`
log = logging.getLogger("mapserver.query.queryable")


class Replies:
    """Answers and refusals on their way out, each with who gives it."""

    def __init__(self, source: MapSource) -> None:
        self._source = source

    def submit(self, pool: AnswerPool, size: int, asked: zenoh.Query, answer: Callable[[], bytes]) -> None:
        """Have a query answered by a thread of a pool."""
        try:
            pool.submit(size, lambda: self._reply(asked, answer))
        except QueryError as error:
            self.refuse(asked, error)

    def refuse(self, asked: zenoh.Query, error: QueryError) -> None:
        """Say why a query is not answered."""
        self._source.count(f"refused_query_{error.reason}")
        with asked:
            _send(asked, lambda: asked.reply_err(encode_error(error)))

    def _reply(self, asked: zenoh.Query, answer: Callable[[], bytes]) -> None:
        try:
            origin = encode_origin(self._source.origin())  # before the answer, which may be of a later row
            data = answer()
        except QueryError as error:
            self.refuse(asked, error)
        except Exception as error:  # a bug must not leave the asker waiting
            log.exception("query failed query=%s", asked.key_expr)
            self.refuse(asked, QueryError("internal", f"the server failed: {error}"))
        else:
            self._source.count(ANSWERED)
            with asked:
                _send(asked, lambda: asked.reply(asked.key_expr, data, attachment=origin))


class MapQueryable:
    """Answers the map queries on a key expression of a session, until closed."""

    def __init__(self, session: zenoh.Session, key: str, source: MapSource, answers: Answers) -> None:
        self._source, self._answers, self._replies = source, answers, Replies(source)
        self._now = AnswerPool("query", source.config.query_threads, ANSWER_BYTES)
        # Another one: a fold of the past must not keep the map as it is from answering.
        self._past = AnswerPool("past", 1, MOST_PAST)
        self._queryable = session.declare_queryable(key, self._on_query)

    def stop(self) -> None:
        """Take no more queries."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Drop what waits, and let what is in work end; after `stop`."""
        self._now.close()
        self._past.close()

    def _on_query(self, asked: zenoh.Query) -> None:
        """Parse a query and let it wait, without a thread, for the journal row that it asks for; then for a thread."""
        try:
            name, parameters = question(asked)
            query = parse_query(name, parameters)
            pool, size = (self._past, 1) if reads_past(query) else (self._now, self._answers.size(query))
        except QueryError as error:
            self._replies.refuse(asked, error)
            return

        def enter(error: QueryError | None) -> None:
            if error:
                self._replies.refuse(asked, error)
            else:
                self._replies.submit(pool, size, asked, lambda: self._answers.answer(query))

        try:
            self._source.waits.add(query.fresh.after, query.fresh.wait_s, enter)
        except QueryError as error:
            self._replies.refuse(asked, error)


def question(asked: zenoh.Query) -> tuple[str, dict[str, str]]:
    """Name and parameters. QueryError for what no client sends: what waits is kept in memory."""
    name, parameters = keys.query_of(str(asked.key_expr)), str(asked.parameters)
    most = PLACES_BYTES if name in WITH_PLACES else MAX_QUESTION
    if len(parameters) > most or asked.payload:
        raise QueryError(Refusal.TOO_LARGE, f"`{name[:40]}` has at most {most} bytes of parameters, and no payload")
    return name, split_selector(parameters)


def _send(asked: zenoh.Query, send: Callable[[], object]) -> None:
    try:
        send()
    except zenoh.ZError as error:  # the asker is gone
        log.info("reply failed query=%s error=%r", asked.key_expr, str(error))
