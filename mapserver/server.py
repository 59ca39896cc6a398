"""The map server's edge to Zenoh: a queryable for batches, one for map queries, one for commands; events of changes.

Callbacks only move bytes to the writer's queue or to other threads: a callback that works stalls the session.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack

import zenoh

from mapserver.claim import WriterClaim
from mapserver.config import ServerConfig
from mapserver.evidence import grid
from mapserver.ingest import batches
from mapserver.ingest.admission import Verify
from mapserver.ingest.store import Incoming, Store
from mapserver.ingest.writer import Writer
from mapserver.journal import records
from mapserver.journal.location import JournalLocation
from mapserver.past.past import Past
from mapserver.query.answer_pool import AnswerPool
from mapserver.query.answering import Answers
from mapserver.upkeep.upkeep import Upkeep
from protocol.errors import ConfigError, QueryError, Refusal
from protocol.queries.answer_codec import encode_change, encode_error
from protocol.queries.answers import GroundChange
from protocol.queries.parameters import split_selector
from protocol.queries.requests import parse_query, reads_past
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import encode_reply
from protocol.wire.messages import Ack, Refused

COMMAND_THREADS = 8  # a command waits for its map; those given meanwhile are kept at once, and folded together
ANSWER_BYTES = 2**25  # of all answers that wait or are in work: 40 pieces, or 2000 points
MOST_PAST, MOST_COMMANDS = 16, 16  # that wait or are in work
MAX_QUESTION = 4096  # bytes of a query's parameters
SignReply = Callable[[str, bytes, bytes], bytes]  # key expression, batch and reply to signature
log = logging.getLogger("mapserver")


class Server:
    """Serves one site over two open sessions until closed. answers: the map, for callers in this process."""

    def __init__(
        self,
        ingest: zenoh.Session,
        readers: zenoh.Session,
        location: JournalLocation,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
        verify: Verify | None = None,
        *,
        sign: SignReply | None = None,
        take_over: bool = False,
    ) -> None:
        """ingest: for batches alone, since an answer that nobody takes holds up its whole link. readers: for all else.

        verify: of signed batches, see Store; without it signatures are not asked for. sign: makes the
        signature that goes beside the reply to a signed batch. take_over: have another server of
        the site end, where there is one; otherwise a LinkError says so.
        """
        self._sign = sign
        with ExitStack() as opened:
            self._claim = WriterClaim(ingest, site.name, location.store_id())
            opened.callback(self._claim.close)
            self._claim.acquire(take_over=take_over)
            self._writer = Writer(Store(location, site, config, now_ns, verify))
            self._claim.store = self._writer.store_id
            opened.pop_all()
        self._changed = readers.declare_publisher(
            keys.changed(site.name), congestion_control=zenoh.CongestionControl.DROP
        )
        past = Past.of_store(location.folder, site.cell_m, config.fold)
        self._upkeep = Upkeep(self._writer, self._publish, past)
        self.answers = Answers(self._writer, self._upkeep, past)
        self._now = AnswerPool("query", config.query_threads, ANSWER_BYTES)
        # Others: a fold of the past, or a command that waits for one, must not keep the map as it is from answering.
        self._past = AnswerPool("past", 1, MOST_PAST)
        self._commands = AnswerPool("command", COMMAND_THREADS, MOST_COMMANDS)
        self._queryables = [
            ingest.declare_queryable(keys.ingest_all(site.name), self._on_batch),
            readers.declare_queryable(keys.map_queries_all(site.name), self._on_query),
            readers.declare_queryable(keys.admin_all(site.name), self._on_command),
        ]

    @property
    def failed(self) -> bool:
        """Whether the writer's thread has died; the process should end."""
        return self._writer.failed

    @property
    def ended(self) -> str:
        """Why another server is the site's writer now, empty while none is; the process should end."""
        return self._claim.ended

    def close(self) -> None:
        """Stop listening, finish what has come in, commit, snapshot."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for pool in (self._now, self._past, self._commands):
            pool.close()
        self._upkeep.close()
        self._changed.undeclare()  # type: ignore[no-untyped-call]
        self._writer.close()
        self._claim.close()  # the last: another server may use the store now

    def _on_batch(self, query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload else b""
        try:
            machine = keys.machine_of(str(query.key_expr))
        except ConfigError:  # a wildcard in the key names no machine
            machine = ""

        signature = query.attachment.to_bytes() if query.attachment else b""

        def reply(answer: Ack | Refused) -> None:
            with query:
                data = encode_reply(answer)
                signed = self._sign(str(query.key_expr), payload, data) if self._sign and signature else None
                try:
                    query.reply(query.key_expr, data, attachment=signed)
                except zenoh.ZError as error:  # the asker is gone; it will ask again
                    log.info("reply failed machine=%s error=%r", machine, str(error))

        if not self._claim.held:
            reply(Refused(Refusal.NOT_WRITER, "it is not certain that no other map server writes; send this one again"))
            return
        self._writer.submit(Incoming(machine, payload, signature), reply)

    def _on_query(self, asked: zenoh.Query) -> None:
        """Parse a query and let it wait, without a thread, for the journal row that it asks for; then for a thread."""
        try:
            name, parameters = _asked(asked)
            query = parse_query(name, parameters)
            pool, size = (self._past, 1) if reads_past(query) else (self._now, self.answers.size(query))
        except QueryError as error:
            self._refuse(asked, error)
            return

        def enter(error: QueryError | None) -> None:
            if error:
                self._refuse(asked, error)
            else:
                self._submit(pool, size, asked, lambda: self.answers.answer(query))

        try:
            self._writer.waits.add(query.fresh.after, query.fresh.wait_s, enter)
        except QueryError as error:
            self._refuse(asked, error)

    def _on_command(self, asked: zenoh.Query) -> None:
        try:
            name, parameters = _asked(asked)
        except QueryError as error:
            self._refuse(asked, error)
        else:
            self._submit(self._commands, 1, asked, lambda: self.answers.obey(name, parameters))

    def _submit(self, pool: AnswerPool, size: int, asked: zenoh.Query, answer: Callable[[], bytes]) -> None:
        try:
            pool.submit(size, lambda: self._reply(asked, answer))
        except QueryError as error:
            self._refuse(asked, error)

    def _reply(self, asked: zenoh.Query, answer: Callable[[], bytes]) -> None:
        try:
            data = answer()
        except QueryError as error:
            self._refuse(asked, error)
        except Exception as error:  # a bug must not leave the asker waiting
            log.exception("query failed query=%s", asked.key_expr)
            self._refuse(asked, QueryError("internal", f"the server failed: {error}"))
        else:
            with asked:
                _send(asked, lambda: asked.reply(asked.key_expr, data))

    def _refuse(self, asked: zenoh.Query, error: QueryError) -> None:
        self._writer.count_refusal(error.reason)
        with asked:
            _send(asked, lambda: asked.reply_err(encode_error(error)))

    def _publish(self, change: GroundChange) -> None:
        self._changed.put(encode_change(change))


def warm_up(config: ServerConfig) -> None:
    """Have all kernels that ingest needs, before the first batch."""
    grid.warm_up(config.fold)
    batches.warm_up()
    records.warm_up()


def _asked(query: zenoh.Query) -> tuple[str, dict[str, str]]:
    """Name and parameters. QueryError for what no client sends: what waits is kept in memory."""
    parameters = str(query.parameters)
    if len(parameters) > MAX_QUESTION or query.payload:
        raise QueryError(Refusal.TOO_LARGE, f"a query has at most {MAX_QUESTION} bytes of parameters, and no payload")
    return keys.query_of(str(query.key_expr)), split_selector(parameters)


def _send(asked: zenoh.Query, send: Callable[[], object]) -> None:
    try:
        send()
    except zenoh.ZError as error:  # the asker is gone
        log.info("reply failed query=%s error=%r", asked.key_expr, str(error))
