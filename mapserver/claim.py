"""One writer for a site: a server takes batches only while no other one claims to write.

Two servers with separate stores would each lack the other's samples. So a server asks others on the key `writer` at its
start, after reconnections and every second, and answers them. Writers precede askers, then the earlier one wins, then
chance; whoever finds a predecessor ends.

Servers of one shared journal coexist: its database decides. But two databases may hold it (a restored copy, an old
primary). Then the server with the lower epoch ends, and none starts whose database lacks an epoch in use.

A query, not a token: a killed server must not block its successor (decision 0005).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from protocol.errors import LinkError, MessageError, StoreError
from protocol.wire import keys
from protocol.wire.fields import take
from protocol.wire.owners import ANSWER_S, EVERY_OTHER, Owner, decode_owner, encode_owner, this_process

ROUNDS = 2  # rounds without an answer; the first after a reconnection may reach nobody (Zenoh issue 2767)
BETWEEN_S = 0.25
WATCH_S = 1.0  # interval of a writer's questions
TAKE_OVER_S = 60.0  # time for the other server to commit, write its snapshot and end
_TWO = "two databases have this journal: a restored copy or an old primary has to go"
log = logging.getLogger("mapserver.claim")


@dataclass(frozen=True)
class Claimant:
    """A server that writes for a site, or asks to.

    store: its id, "" for none yet. shared: several servers share its journal. epoch: of a shared journal's writer, 0
    while waiting.
    """

    owner: Owner
    store: str
    writes: bool
    shared: bool = False
    epoch: int = 0

    def has_journal_of(self, other: Claimant) -> bool:
        """Whether both share one journal."""
        return self.shared and other.shared and self.store != "" and self.store == other.store

    def precedes(self, other: Claimant) -> bool:
        """Whether this one continues and the other ends."""
        if self.has_journal_of(other):
            both_write = self.epoch > 0 and other.epoch > 0
            return both_write and (-self.epoch, self.owner) < (-other.epoch, other.owner)
        return (not self.writes, self.owner) < (not other.writes, other.owner)

    def __str__(self) -> str:
        return f"{self.owner}" + (f", with store {self.store}" if self.store else ", with a new store")


class WriterClaim:
    """The claim of one server; thread-safe, except for `acquire`.

    held: it may take batches. ended: why it must end, or ""; superseded: the same, by a server of the same journal.
    epoch: see `Claimant`; it may change.
    """

    def __init__(
        self,
        session: zenoh.Session,
        site: str,
        store: str,
        *,
        shared: bool = False,
        known_epoch: Callable[[], int] = lambda: 0,
    ) -> None:
        """store: its id, "" if not created yet. shared: see `Claimant`.

        known_epoch: the newest in this server's database; StoreError if unreachable.
        """
        self.store, self.shared, self.held, self.ended, self.superseded = store, shared, False, "", ""
        self.epoch: Callable[[], int] = lambda: 0
        self._known_epoch = known_epoch
        self._session, self._site, self._key = session, site, keys.writer(site)
        self._owner, self._writes = this_process(), False
        self._behind_router = bool(session.info.routers_zid())
        self._rounds = 0  # without a rival, since the last change of the router's link
        self._changed, self._ending = threading.Event(), False
        self._watch = threading.Thread(target=self._run, name="claim", daemon=True)
        # declared before asking: of two simultaneous starts, one hears the other
        self._answer = session.declare_queryable(self._key, self._on_query)
        self._links = session.info.declare_transport_events_listener(self._on_link)

    def acquire(self, *, take_over: bool = False) -> None:
        """Become the site's writer; LinkError if another one is. take_over: make another one end, and wait for it."""
        end_s = time.monotonic() + TAKE_OVER_S
        while self._rounds < ROUNDS:
            rival = self._ask(take_over=take_over)
            if rival and not (take_over and rival.writes and time.monotonic() < end_s):
                raise LinkError(f"site {self._site}", self._problem(rival))
            self._rounds = 0 if rival else self._rounds + 1
            time.sleep(BETWEEN_S)
        self._writes = self.held = True
        self._watch.start()

    def require(self) -> None:
        """LinkError if this server must end."""
        if self.ended:
            raise LinkError(f"site {self._site}", self.ended)

    def close(self) -> None:
        """Release the claim."""
        self._ending = True
        self._changed.set()
        if self._watch.is_alive():
            self._watch.join()
        for entity in (self._links, self._answer):
            entity.undeclare()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        while not (self._ending or self.ended or self.superseded):
            self._changed.wait(WATCH_S if self.held else BETWEEN_S)
            self._changed.clear()
            if self._behind_router and not self._session.info.routers_zid():
                continue  # nobody could answer
            if rival := self._ask():
                self._end_for(rival)
            elif not self.held:
                self._rounds += 1
                self._writes = self.held = self._rounds >= ROUNDS

    def _ask(self, *, take_over: bool = False) -> Claimant | None:
        """The first of its predecessors."""
        question = self._encoded(take_over=take_over)
        replies = self._session.get(self._key, payload=question, timeout=ANSWER_S, **EVERY_OTHER)
        others = [other for reply in replies if (other := _claimant(reply)) and other.owner != self._owner]
        before = [other for other in others if other.precedes(self._this) or self._is_elsewhere(other)]
        return min(before, key=lambda other: (not other.writes, other.owner), default=None)

    @property
    def _this(self) -> Claimant:
        return Claimant(self._owner, self.store, self._writes, self.shared, self.epoch())

    def _encoded(self, **more: Any) -> bytes:
        this = self._this
        words = {"store": this.store, "writes": this.writes, "shared": this.shared, "epoch": this.epoch}
        return encode_owner(self._owner, **words, **more)

    def _is_elsewhere(self, other: Claimant) -> bool:
        """Whether another server writes this journal in another database, while this one waits."""
        if self.epoch() or not (other.epoch and other.has_journal_of(self._this)):
            return False
        try:
            return other.epoch > self._known_epoch()
        except StoreError:  # away: nobody starts in it now
            return False

    def _problem(self, rival: Claimant) -> str:
        if rival.has_journal_of(self._this):
            return f"{rival} writes with epoch {rival.epoch}, of which this server's database does not know; {_TWO}"
        return f"a map server runs already, {rival}; stop it, or start this one with --take-over"

    def _end_for(self, rival: Claimant) -> None:
        if not rival.has_journal_of(self._this):
            self._end(f"another map server writes for site {self._site}, {rival}")
        elif epoch := self.epoch():
            self.held = False
            both = f"{rival} writes with epoch {rival.epoch}, and this one with {epoch}"
            self.superseded = f"{both}; if it is not just that it took over, {_TWO}"
            log.error("claim lost problem=%r", self.superseded)
        else:
            self._end(self._problem(rival))

    def _end(self, why: str) -> None:
        self.held, self.ended = False, why
        log.error("claim lost problem=%r", why)

    def _on_query(self, query: zenoh.Query) -> None:
        with query:
            try:
                asker, table = _decoded(query.payload)
                waits = not self.epoch() and self._this.has_journal_of(asker)  # a waiting server is no obstacle
                if take(table, "take_over", bool, default=False) and self._writes and not (waits or self.ended):
                    self._end(f"another map server takes over site {self._site}, {asker.owner}")
            except MessageError as error:  # an answer is owed anyway
                log.warning("claim unread error=%r", str(error))
            query.reply(query.key_expr, self._encoded())

    def _on_link(self, event: zenoh.TransportEvent) -> None:
        """Renew the claim, because another server may have started meanwhile."""
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            self.held, self._writes, self._rounds = False, False, 0
            self._changed.set()


def _claimant(reply: zenoh.Reply) -> Claimant | None:
    try:
        return _decoded(reply.ok.payload if reply.ok else None)[0]
    except MessageError:
        return None


def _decoded(payload: zenoh.ZBytes | None) -> tuple[Claimant, dict[str, Any]]:
    """A claimant, and its whole table."""
    owner, table = decode_owner(payload.to_bytes() if payload else b"")
    named = take(table, "store", str), take(table, "writes", bool), take(table, "shared", bool)
    return Claimant(owner, *named, take(table, "epoch", int)), table
