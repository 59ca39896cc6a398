"""The map server's edge to Zenoh: a queryable for batches and one for map queries.

Callbacks only move bytes to the writer's queue or to the query threads (EVIDENCE: work in a callback stalls it).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import zenoh

from mapserver.answers import Answers
from mapserver.config import ServerConfig
from mapserver.store import Incoming
from mapserver.writer import Writer
from protocol import keys
from protocol.codec import encode_reply
from protocol.errors import ConfigError, QueryError
from protocol.messages import Ack, Refused
from protocol.queries import encode_error
from protocol.site import SiteConfig

log = logging.getLogger("mapserver")


class Server:
    """Serves one site over an open session until closed."""

    def __init__(
        self,
        session: zenoh.Session,
        folder: Path,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
    ) -> None:
        self._writer = Writer(folder, site, config, now_ns)
        self._answers = Answers(self._writer, site, config.read)
        self._threads = ThreadPoolExecutor(config.query_threads, thread_name_prefix="query")
        self._queryables = [
            session.declare_queryable(keys.ingest_all(site.name), self._on_batch),
            session.declare_queryable(keys.map_queries_all(site.name), self._on_query),
        ]

    @property
    def answers(self) -> Answers:
        """The map, for callers in this process."""
        return self._answers

    @property
    def failed(self) -> bool:
        """Whether the writer's thread has died; the process should end."""
        return self._writer.failed

    def close(self) -> None:
        """Stop listening, finish what has come in, commit, snapshot."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        self._threads.shutdown()
        self._writer.close()

    def _on_batch(self, query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload else b""
        try:
            machine = keys.machine_of(str(query.key_expr))
        except ConfigError:  # a wildcard in the key names no machine
            machine = ""

        def reply(answer: Ack | Refused) -> None:
            with query:
                try:
                    query.reply(query.key_expr, encode_reply(answer))
                except zenoh.ZError as error:  # the asker is gone; it will ask again
                    log.info("reply failed machine=%s error=%r", machine, str(error))

        self._writer.submit(Incoming(machine, payload), reply)

    def _on_query(self, query: zenoh.Query) -> None:
        self._threads.submit(self._answer, query)

    def _answer(self, query: zenoh.Query) -> None:
        name = keys.query_of(str(query.key_expr))
        parameters = dict(_pairs(query))
        with query:
            try:
                query.reply(query.key_expr, self._answers.answer(name, parameters))
            except QueryError as error:
                self._writer.count_refusal(error.reason)
                query.reply_err(encode_error(error))
            except zenoh.ZError as error:
                log.info("reply failed query=%s error=%r", name, str(error))
            except Exception as error:  # a bug must not leave the asker waiting, nor end the thread silently
                log.exception("query failed query=%s", name)
                query.reply_err(encode_error(QueryError("internal", f"the server failed: {error}")))


def _pairs(query: zenoh.Query) -> list[tuple[str, str]]:
    """Split the selector's parameters by hand, because a missing value must be seen as one."""
    text = str(query.parameters)
    return [(part.partition("=")[0], part.partition("=")[2]) for part in text.split(";") if part]
