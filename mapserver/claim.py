"""One writer for a site: a server takes batches only while no other one answers that it does.

Of two servers with two stores each would take samples that the other lacks. So a server asks all others on the key
`writer`, at its start, after each reconnection and once a second, and answers them. Who writes comes before who asks;
of two alike the earlier one, then by chance. Whoever finds another one before itself ends.

Servers of one shared journal let each other be: its database says whose turn it is. But two databases may hold the same
journal, as one that was restored beside the first, or a replica that was promoted while the old primary lives. Then
two servers both take batches, each by its own database; the one with the lower epoch ends, and none begins whose
database does not know of an epoch that another server writes with.

A query that must be answered, and no token: a server that was killed never keeps its successor waiting (decision 0005).
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

ROUNDS = 2  # without an answer: the first question after a reconnection may find nobody (Zenoh issue 2767)
BETWEEN_S = 0.25
WATCH_S = 1.0  # between two questions of a writer
TAKE_OVER_S = 60.0  # for the other one to commit, write its snapshot, and end
_TWO = "two databases have this journal: a restored copy or an old primary has to go"
log = logging.getLogger("mapserver.claim")


@dataclass(frozen=True)
class Claimant:
    """A server that writes for a site, or asks whether it may.

    store: id of its store, empty where it has none yet. shared: whether servers take turns in writing its journal; of
    those with one journal its database says whose turn it is. epoch: that it writes a shared journal with, 0 while it
    waits for its turn.
    """

    owner: Owner
    store: str
    writes: bool
    shared: bool = False
    epoch: int = 0

    def has_journal_of(self, other: Claimant) -> bool:
        """Whether both have one journal, which only one of them may write at a time."""
        return self.shared and other.shared and self.store != "" and self.store == other.store

    def precedes(self, other: Claimant) -> bool:
        """Whether this one goes on, and the other one ends."""
        if self.has_journal_of(other):
            both_write = self.epoch > 0 and other.epoch > 0
            return both_write and (-self.epoch, self.owner) < (-other.epoch, other.owner)
        return (not self.writes, self.owner) < (not other.writes, other.owner)

    def __str__(self) -> str:
        return f"{self.owner}" + (f", with store {self.store}" if self.store else ", with a new store")


class WriterClaim:
    """The claim of one server. All but `acquire` is for any thread.

    held: whether it may take batches now. ended: why it has to end, empty while it need not; superseded: the same where
    that is another server with the same journal. epoch: see `Claimant`; it may change.
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
        """store: id of the store, empty where it is to be made: it may be set later. shared: see `Claimant`.

        known_epoch: the newest one that this server's database knows; StoreError where that cannot be asked.
        """
        self.store, self.shared, self.held, self.ended, self.superseded = store, shared, False, "", ""
        self.epoch: Callable[[], int] = lambda: 0
        self._known_epoch = known_epoch
        self._session, self._site, self._key = session, site, keys.writer(site)
        self._owner, self._writes = this_process(), False
        self._behind_router = bool(session.info.routers_zid())
        self._rounds = 0  # without another one, since the link to the router changed
        self._changed, self._ending = threading.Event(), False
        self._watch = threading.Thread(target=self._run, name="claim", daemon=True)
        # Declared before anybody is asked: of two servers that start at once, one at least is heard by the other.
        self._answer = session.declare_queryable(self._key, self._on_query)
        self._links = session.info.declare_transport_events_listener(self._on_link)

    def acquire(self, *, take_over: bool = False) -> None:
        """Become the site's writer; LinkError if another one is, or becomes it.

        take_over: have another one end instead, and wait until it has.
        """
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
        """LinkError where this server has to end."""
        if self.ended:
            raise LinkError(f"site {self._site}", self.ended)

    def close(self) -> None:
        """Let another one write."""
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
                continue  # nobody could be asked
            if rival := self._ask():
                self._end_for(rival)
            elif not self.held:
                self._rounds += 1
                self._writes = self.held = self._rounds >= ROUNDS

    def _ask(self, *, take_over: bool = False) -> Claimant | None:
        """The first of the others that come before this one."""
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
        """Whether another server writes this server's journal in another database, while this one does not yet."""
        if self.epoch() or not (other.epoch and other.has_journal_of(self._this)):
            return False
        try:
            return other.epoch > self._known_epoch()
        except StoreError:  # it is away: nobody begins in it now
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
                waits = not self.epoch() and self._this.has_journal_of(asker)  # it is no obstacle
                if take(table, "take_over", bool, default=False) and self._writes and not (waits or self.ended):
                    self._end(f"another map server takes over site {self._site}, {asker.owner}")
            except MessageError as error:  # an answer is owed all the same
                log.warning("claim unread error=%r", str(error))
            query.reply(query.key_expr, self._encoded())

    def _on_link(self, event: zenoh.TransportEvent) -> None:
        """Nothing is certain once the link to the router has changed: another one may have started meanwhile."""
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            self.held, self._writes, self._rounds = False, False, 0
            self._changed.set()


def _claimant(reply: zenoh.Reply) -> Claimant | None:
    try:
        return _decoded(reply.ok.payload if reply.ok else None)[0]
    except MessageError:
        return None


def _decoded(payload: zenoh.ZBytes | None) -> tuple[Claimant, dict[str, Any]]:
    """A claimant, and all that it says."""
    owner, table = decode_owner(payload.to_bytes() if payload else b"")
    named = take(table, "store", str), take(table, "writes", bool), take(table, "shared", bool)
    return Claimant(owner, *named, take(table, "epoch", int)), table
