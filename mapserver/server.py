"""The map server's edge to Zenoh: batches, map queries, commands, and events of changes.

Callbacks only move bytes: one that works stalls the session.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import zenoh

from mapserver.calibration import ledger
from mapserver.change import change_log
from mapserver.claim import WriterClaim
from mapserver.config import ServerConfig
from mapserver.evidence import grid
from mapserver.ingest import batches, block_credit
from mapserver.ingest.admission import Verify
from mapserver.ingest.standby import Standby
from mapserver.ingest.store import Incoming, Store
from mapserver.ingest.writer import Writer
from mapserver.journal import records
from mapserver.journal.location import JournalLocation
from mapserver.past.past import StorePast
from mapserver.query import road_maps, routes
from mapserver.query.answering import Answers
from mapserver.query.queryable import AnswerPool, MapQueryable, Replies, question
from mapserver.query.road_maps import RoadMaps
from mapserver.query.server_source import CommandDesk, ServerReading, ServerSource
from mapserver.upkeep.upkeep import Upkeep
from protocol.errors import ConfigError, QueryError, Refusal
from protocol.queries.answer_codec import encode_change
from protocol.queries.answers import GroundChange
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import encode_reply
from protocol.wire.messages import Ack, Refused

COMMAND_THREADS = 8  # threads: a command waits for its map; others are stored meanwhile, and folded together
MOST_COMMANDS = 16  # waiting and running commands
SignReply = Callable[[str, bytes, bytes], bytes]  # arguments: key expression, batch, reply to sign
log = logging.getLogger("mapserver")


class Server:
    """Serves one site over two open sessions. answers: the map, for this process."""

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
        standing_by: Callable[[bool], None] = lambda _: None,
    ) -> None:
        """ingest: only for batches, because an unread answer blocks its link. readers: for all else.

        verify: see Store; without it signatures are not required. sign: replies to signed batches. take_over: end
        another server, instead of LinkError. standing_by: called while another server writes a shared journal, with
        whether this one is up to date; exceptions end the wait.
        """
        self._sign = sign
        with ExitStack() as opened:
            store = location.prepared_id(site.name, site.frame)
            shared, known_epoch = location.is_shared, location.epoch
            self._claim = claim = WriterClaim(ingest, site.name, store, shared=shared, known_epoch=known_epoch)
            opened.callback(self._claim.close)
            self._claim.acquire(take_over=take_over)

            def check(warm: bool) -> None:  # noqa: FBT001
                standing_by(warm)
                claim.require()

            standby = Standby(location, site, config, check) if location.is_shared else None
            if standby:
                opened.callback(standby.close)
            self._writer = Writer(Store(location, site, config, now_ns, verify, standby))
            if standby:
                standby.close()
            self._claim.store, self._claim.epoch = self._writer.store_id, lambda: self._writer.epoch
            opened.pop_all()
        self._changed = readers.declare_publisher(
            keys.changed(site.name), congestion_control=zenoh.CongestionControl.DROP
        )
        past = StorePast.of_store(location.folder, site.cell_m, config.fold)
        roads = RoadMaps(ServerReading(self._writer, past))
        self._upkeep = Upkeep(self._writer, self._publish, past, roads.repairs)
        source = ServerSource(self._writer, self._upkeep, past)
        self.answers = Answers(source, roads)
        self._replies, self._commands = Replies(source), CommandDesk(self._writer, self._upkeep, self.answers.info)
        self._pool = AnswerPool("command", COMMAND_THREADS, MOST_COMMANDS)
        self._queries = MapQueryable(readers, keys.map_queries_all(site.name), source, self.answers)
        self._queryables = [
            ingest.declare_queryable(keys.ingest_all(site.name), self._on_batch),
            readers.declare_queryable(keys.admin_all(site.name), self._on_command),
        ]

    def lives(self) -> bool:
        """Whether the writer takes batches, neither ended nor hanging."""
        try:
            return bool(self._writer.alive())
        except QueryError:
            return False

    def changes(self) -> list[GroundChange]:
        """Changes of the ground so far."""
        return self._upkeep.changes()

    @property
    def failed(self) -> bool:
        """Whether the writer's thread has died; the process should end."""
        return self._writer.failed

    @property
    def ended(self) -> str:
        """Why another server is the writer, or ""; the process should end."""
        return self._claim.ended

    @property
    def fenced(self) -> str:
        """Why another server took over, or ""; the process should end."""
        return self._writer.fenced or self._claim.superseded

    def close(self) -> None:
        """Stop listening, finish received batches, commit, snapshot."""
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        self._queries.stop()
        self._queries.close()
        self._pool.close()
        self._upkeep.close()
        self._changed.undeclare()  # type: ignore[no-untyped-call]
        self._writer.close()
        self._claim.close()  # last, because another server may then use the store

    def _on_batch(self, query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload else b""
        try:
            machine = keys.machine_of(str(query.key_expr))
        except ConfigError:  # a wildcard names no machine
            machine = ""

        signature = query.attachment.to_bytes() if query.attachment else b""

        def reply(answer: Ack | Refused) -> None:
            with query:
                data = encode_reply(answer)
                signed = self._sign(str(query.key_expr), payload, data) if self._sign and signature else None
                try:
                    query.reply(query.key_expr, data, attachment=signed)
                except zenoh.ZError as error:  # the asker is gone and will ask again
                    log.info("reply failed machine=%s error=%r", machine, str(error))

        if not self._claim.held:
            reply(Refused(Refusal.NOT_WRITER, "it is not certain that no other map server writes; send this one again"))
            return
        self._writer.submit(Incoming(machine, payload, signature), reply)

    def _on_command(self, asked: zenoh.Query) -> None:
        try:
            name, parameters = question(asked)
        except QueryError as error:
            self._replies.refuse(asked, error)
        else:
            self._replies.submit(self._pool, 1, asked, lambda: self._commands.obey(name, parameters))

    def _publish(self, change: GroundChange) -> None:
        self._changed.put(encode_change(change))


def warm_up(config: ServerConfig) -> None:
    """Load the kernels of ingest and of a point before the first batch and question."""
    grid.warm_up(config.fold)
    batches.warm_up()
    block_credit.warm_up(config.fold)
    records.warm_up()
    change_log.warm_up(config.fold)


def warm_up_rest(config: ServerConfig) -> Iterator[None]:
    """Load all other kernels, one part at each step: calibration, roads, routes."""
    ledger.warm_up()
    yield
    road_maps.warm_up(config.fold)
    yield
    routes.warm_up()
