"""Map queries from Zenoh: each waits for its journal row, then for a thread, and is answered.

Callbacks only pass queries on: one that works stalls the session. Answers share one budget of bytes, because Zenoh does
not tell who asks.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping

import zenoh

from mapserver.query.answering import Answers
from mapserver.query.source import MapSource
from protocol.errors import QueryError, Refusal
from protocol.queries.answer_codec import encode_error
from protocol.queries.origin import encode_origin
from protocol.queries.parameters import ValueForm, split_selector
from protocol.queries.places import PLACES_BYTES
from protocol.queries.request import parameters_of
from protocol.queries.requests import QUERIES, parse_query
from protocol.wire import keys

END_S = 1.0  # longest wait for running answers at the end
MIN_RETRY_S, MAX_RETRY_S = 0.5, 30.0
Work = tuple[int, Callable[[], None]]  # size and task
Order = Callable[[Mapping[int, Work]], int]  # the next of those waiting


class AnswerPool:
    """Tasks for several threads.

    The first takes the smallest waiting task, so small answers pass large ones; others take the oldest, so large ones
    get their turn.
    """

    def __init__(self, name: str, threads: int, budget: int, spare: Callable[[], float] | None = None) -> None:
        """budget: total size of tasks, waiting and running.

        spare: one thread does it while no task waits; returns the seconds until it is due again.
        """
        self._budget, self._size = budget, 0
        self._spare, self._spare_s = spare, 0.0 if spare else math.inf  # when it is due; infinite while it is done
        self._waiting: dict[int, Work] = {}  # by number, oldest first
        self._numbers = itertools.count()
        self._mean_s = 0.0  # duration of an answer
        self._closed = False
        self._news = threading.Condition()
        self._threads = [
            threading.Thread(target=self._run, args=(order,), name=f"{name}-{number}", daemon=True)
            for number, order in enumerate([_smallest, *[_oldest] * (threads - 1)])
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, size: int, work: Callable[[], None]) -> None:
        """Queue `work`; QueryError if the budget is exceeded."""
        with self._news:
            if self._size + size > self._budget:
                expected_s = self._mean_s * len(self._waiting) / len(self._threads)
                retry_s = round(min(max(expected_s, MIN_RETRY_S), MAX_RETRY_S), 1)
                raise QueryError(Refusal.OVERLOADED, "the server has too many queries to answer", retry_s)
            self._size += size
            self._waiting[next(self._numbers)] = size, work
            self._news.notify()

    def prompt(self) -> None:
        """Have the spare work done soon."""
        with self._news:
            self._spare_s = 0.0
            self._news.notify()

    def close(self) -> None:
        """Drop waiting tasks, and let running ones end."""
        with self._news:
            self._closed = True
            self._waiting.clear()
            self._news.notify_all()
        end_s = time.monotonic() + END_S
        for thread in self._threads:
            thread.join(max(0.0, end_s - time.monotonic()))

    def _run(self, order: Order) -> None:
        while (taken := self._take(order)) is not None:
            (size, work), began_s = taken, time.monotonic()
            try:
                work()
            except Exception:  # a bug must not end the thread
                log.exception("answer failed")
            del taken, work  # frees the query with it
            with self._news:
                self._size -= size
                if size:
                    self._mean_s += 0.1 * (time.monotonic() - began_s - self._mean_s)

    def _take(self, order: Order) -> Work | None:
        with self._news:
            while not (self._waiting or self._closed):
                left_s = self._spare_s - time.monotonic()
                if left_s <= 0.0:
                    self._spare_s = math.inf
                    return 0, self._do_spare
                self._news.wait(left_s if left_s < math.inf else None)
            if self._closed:
                return None
            return self._waiting.pop(order(self._waiting))

    def _do_spare(self) -> None:
        wait_s = MAX_RETRY_S  # after a bug
        try:
            wait_s = self._spare() if self._spare else math.inf
        finally:
            with self._news:
                self._spare_s = min(self._spare_s, time.monotonic() + wait_s)
                self._news.notify()


def _smallest(waiting: Mapping[int, Work]) -> int:
    return min(waiting, key=lambda number: (waiting[number][0], number))


def _oldest(waiting: Mapping[int, Work]) -> int:
    return next(iter(waiting))


ANSWER_BYTES = 2**25  # budget of waiting and running answers: 40 pieces, or 2000 points
MOST_PAST = 16  # waiting and running answers of the past
MAX_QUESTION = 4096  # bytes of a query's parameters
WITH_PLACES = {
    name
    for name, query in QUERIES.items()
    if any(p.kind.form is ValueForm.PLACES for p in parameters_of(query).values())
}
ANSWERED = "queries_answered"  # counter in `info`
log = logging.getLogger("mapserver.query.queryable")


class Replies:
    """Sends answers and refusals, with their origin."""

    def __init__(self, source: MapSource) -> None:
        self._source = source

    def submit(self, pool: AnswerPool, size: int, asked: zenoh.Query, answer: Callable[[], bytes]) -> None:
        """Have a query answered by a pool."""
        try:
            pool.submit(size, lambda: self._reply(asked, answer))
        except QueryError as error:
            self.refuse(asked, error)

    def refuse(self, asked: zenoh.Query, error: QueryError) -> None:
        """Send the reason of a refusal."""
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
    """Answers map queries on a key expression."""

    def __init__(self, session: zenoh.Session, key: str, source: MapSource, answers: Answers) -> None:
        self._source, self._answers, self._replies = source, answers, Replies(source)
        self._now = AnswerPool("query", source.config.query_threads, ANSWER_BYTES, source.waits.time_out)
        self._past = AnswerPool("past", 1, MOST_PAST)  # apart, so that a fold of the past never delays the current map
        answers.begin()
        self._large = AnswerPool("large", 1, ANSWER_BYTES, answers.renew)  # one large answer at a time; then roads
        self._queryable = session.declare_queryable(key, self._on_query)

    def stop(self) -> None:
        """Take no more queries."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Drop waiting queries, and let running ones end; after `stop`."""
        for pool in (self._now, self._past, self._large):
            pool.close()

    def _on_query(self, asked: zenoh.Query) -> None:
        """Parse a query; it waits for its row without a thread, then for a thread."""
        try:
            name, parameters = question(asked)
            query = parse_query(name, parameters)
            pool, size = self._large if query.is_long else self._now, self._answers.size(query)
            if self._answers.reads_past(query):
                pool, size = self._past, 1
        except QueryError as error:
            self._replies.refuse(asked, error)
            return

        def enter(error: QueryError | None) -> None:
            if error:
                self._replies.refuse(asked, error)
            else:
                self._replies.submit(pool, size, asked, lambda: self._answers.answer(query))

        try:  # whoever merges the row has no time to answer
            if self._source.waits.add(
                query.after, query.wait_s, lambda error: self._now.submit(0, lambda: enter(error))
            ):
                self._now.prompt()
            else:
                enter(None)
        except QueryError as error:
            self._replies.refuse(asked, error)


def question(asked: zenoh.Query) -> tuple[str, dict[str, str]]:
    """Name and parameters; QueryError if too large, because waiting queries stay in memory."""
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
