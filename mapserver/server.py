"""The map server's edge to Zenoh: a queryable for batches, one for map queries, one for commands; events of changes.

Callbacks only move bytes to the writer's queue or to other threads: a callback that works stalls the session.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import zenoh

from mapserver.config import ServerConfig
from mapserver.evidence import grid
from mapserver.follower.follower import Follower
from mapserver.ingest import batches
from mapserver.ingest.store import Incoming, Store, Verify
from mapserver.ingest.writer import Writer
from mapserver.journal import records
from mapserver.query.answering import Answers, reads_past
from protocol.errors import ConfigError, QueryError
from protocol.queries.answer_codec import encode_change, encode_error
from protocol.queries.answers import GroundChange
from protocol.queries.parameters import split_selector
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import encode_reply
from protocol.wire.messages import Ack, Refused

COMMAND_THREADS = 8  # a command waits for its map; those given meanwhile are kept at once, and folded together
log = logging.getLogger("mapserver")


class Server:
    """Serves one site over two open sessions until closed. answers: the map, for callers in this process."""

    def __init__(
        self,
        ingest: zenoh.Session,
        readers: zenoh.Session,
        folder: Path,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
        verify: Verify | None = None,
    ) -> None:
        """ingest: for batches alone, since an answer that nobody takes holds up its whole link. readers: for all else.

        verify: of signed batches, see Store; without it signatures are not asked for.
        """
        self._writer = Writer(Store(folder, site, config, now_ns, verify))
        self._changed = readers.declare_publisher(
            keys.changed(site.name), congestion_control=zenoh.CongestionControl.DROP
        )
        self._follower = Follower(self._writer, self._publish)
        self.answers = Answers(self._writer, self._follower)
        self._threads = ThreadPoolExecutor(config.query_threads, thread_name_prefix="query")
        # Others: a fold of the past, or a command that waits for one, must not keep the map as it is from answering.
        self._past_thread = ThreadPoolExecutor(1, thread_name_prefix="past")
        self._command_threads = ThreadPoolExecutor(COMMAND_THREADS, thread_name_prefix="command")
        self._queryables = [
            ingest.declare_queryable(keys.ingest_all(site.name), self._on_batch),
            readers.declare_queryable(keys.map_queries_all(site.name), self._on_query),
            readers.declare_queryable(keys.admin_all(site.name), self._on_command),
        ]

    @property
    def failed(self) -> bool:
        """Whether the writer's thread has died; the process should end."""
        return self._writer.failed

    def close(self) -> None:
        """Stop listening, finish what has come in, commit, snapshot."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for threads in (self._threads, self._past_thread, self._command_threads):
            threads.shutdown(wait=False, cancel_futures=True)  # nobody waits for an answer longer than for the end
        self._follower.close()
        self._changed.undeclare()  # type: ignore[no-untyped-call]
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

        signature = query.attachment.to_bytes() if query.attachment else b""
        self._writer.submit(Incoming(machine, payload, signature), reply)

    def _on_query(self, query: zenoh.Query) -> None:
        name, parameters = _asked(query)
        threads = self._past_thread if reads_past(name, parameters) else self._threads
        threads.submit(self._reply, query, lambda: self.answers.answer(name, parameters))

    def _on_command(self, query: zenoh.Query) -> None:
        name, parameters = _asked(query)
        self._command_threads.submit(self._reply, query, lambda: self.answers.obey(name, parameters))

    def _reply(self, query: zenoh.Query, answer: Callable[[], bytes]) -> None:
        with query:
            try:
                query.reply(query.key_expr, answer())
            except QueryError as error:
                self._writer.count_refusal(error.reason)
                query.reply_err(encode_error(error))
            except zenoh.ZError as error:
                log.info("reply failed query=%s error=%r", query.key_expr, str(error))
            except Exception as error:  # a bug must not leave the asker waiting, nor end the thread silently
                log.exception("query failed query=%s", query.key_expr)
                query.reply_err(encode_error(QueryError("internal", f"the server failed: {error}")))

    def _publish(self, change: GroundChange) -> None:
        self._changed.put(encode_change(change))


def warm_up(config: ServerConfig) -> None:
    """Have all kernels that ingest needs, before the first batch."""
    grid.warm_up(config.fold)
    batches.warm_up()
    records.warm_up()


def _asked(query: zenoh.Query) -> tuple[str, dict[str, str]]:
    return keys.query_of(str(query.key_expr)), split_selector(str(query.parameters))
