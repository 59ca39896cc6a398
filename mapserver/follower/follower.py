"""A follower's edge to Zenoh and its source of answers.

It answers under its own name, and shows a token while its map is current.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import zenoh

from mapserver.config import ServerConfig
from mapserver.ingest.following import Following
from mapserver.ingest.map_info import by_machine, map_info
from mapserver.ingest.replica import Replica
from mapserver.ingest.store import ACCEPTED
from mapserver.journal import shortfall
from mapserver.journal.facts import Facts
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Progress
from mapserver.journal.shortfall import Shortfall
from mapserver.past.checkpoints import snapshot_rows
from mapserver.past.past import StorePast
from mapserver.query.answering import Answers
from mapserver.query.queryable import MapQueryable
from protocol.errors import LinkError, QueryError, Refusal, StoreError
from protocol.queries.answers import GroundChange, ServerAlive
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.origin import SHOWN_S, Origin
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.owners import ANSWER_S, EVERY_OTHER, Owner, encode_owner, owner_of, this_process

LOOK_S = 2.0  # interval of looks for another follower of this name
HANGS_S = 30.0  # longest time without a look at the journal, normally every second
T = TypeVar("T")


class Follower:
    """Answers queries of one site from a journal. Call `tend` twice a second."""

    def __init__(
        self,
        session: zenoh.Session,
        name: str,
        journal: JournalLocation,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
    ) -> None:
        """LinkError if the name is taken."""
        self._session, self._owner, self._key = session, this_process(), keys.follower_owner(site.name, name)
        self._token_key = keys.follower_alive(site.name, name)
        self._token: zenoh.LivelinessToken | None = None
        self._rivals: set[Owner] = set()
        self._look_s = time.monotonic() + LOOK_S
        self.following = Following(journal, site, config)
        self.source = FollowerSource(name, self.following, now_ns)
        self.answers = Answers(self.source)
        # declared before asking: of two starting at once, one hears the other
        self._identity = session.declare_queryable(self._key, self._on_owner)
        others = (owner_of(reply) for reply in session.get(self._key, timeout=ANSWER_S, **EVERY_OTHER))
        self._rivals = {owner for owner in others if owner}
        if self.ended:
            self._identity.undeclare()  # type: ignore[no-untyped-call]
            self.following.close()
            raise LinkError(f"follower {name}", f"{self.ended}; choose another --name")
        self._queries = MapQueryable(session, keys.follower_queries(site.name, name), self.source, self.answers)
        self.following.start()

    @property
    def is_shown(self) -> bool:
        """Whether clients see it."""
        return self._token is not None

    @property
    def ended(self) -> str:
        """Why it must end, or ""."""
        if earlier := [owner for owner in self._rivals if owner < self._owner]:
            return f"another follower has this name, {min(earlier)}"
        return self.following.ended

    def tend(self) -> None:
        """Show the token while the map is current; look for others of this name."""
        _, behind_s = self.following.behind()
        if behind_s <= SHOWN_S and not self._token:
            self._token = self._session.liveliness().declare_token(self._token_key)
        elif behind_s > SHOWN_S and self._token:
            logging.getLogger("mapserver.follower").warning("behind seconds=%.0f: clients ask others", behind_s)
            self._hide()
        if time.monotonic() >= self._look_s:
            self._look_s = time.monotonic() + LOOK_S
            self._session.get(self._key, self._on_other, timeout=ANSWER_S, **EVERY_OTHER)

    def close(self) -> None:
        """Take no more queries; finish present ones."""
        self._hide()
        self._queries.stop()
        self.following.stop()
        self._queries.close()
        self._identity.undeclare()  # type: ignore[no-untyped-call]
        self.following.close()

    def _hide(self) -> None:
        if self._token:
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._token = None

    def _on_owner(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, encode_owner(self._owner))

    def _on_other(self, reply: zenoh.Reply) -> None:
        if (owner := owner_of(reply)) and owner != self._owner:
            self._rivals = self._rivals | {owner}


class FollowerSource:
    """See `MapSource`. Only the server has the audit's and solver's results."""

    def __init__(self, name: str, following: Following, now_ns: Callable[[], int]) -> None:
        self.name, self._following, self._now_ns = name, following, now_ns
        self.site, self.config, self.location = following.site, following.config, following.location
        self.waits = following.waits
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def past(self) -> StorePast:
        """See `Following`."""
        return self._following.past

    def run(self, work: Callable[[Replica], T]) -> T:
        """See `Following`."""
        return self._following.run(work)

    def changes(self, after: int) -> list[GroundChange]:
        """Changes read from the journal."""
        known = self.run(lambda replica: sorted(replica.changes.items()))
        return [change for number, change in known if number > after]

    def machines(self) -> list[dict[str, Any]]:
        """Only at the server."""
        _only_at_the_server("what the audit of machines found")

    def calibration(self) -> CalibrationAnswer:
        """Only at the server."""
        _only_at_the_server("what is known of calibrations")

    def info(self) -> dict[str, Any]:
        """As the server's, of this process."""
        now_ns, past = self._now_ns(), self.past

        def described(replica: Replica) -> tuple[dict[str, Any], int, Facts]:
            state = (replica.grid, replica.facts, replica.version, replica.newest_ns)
            return map_info(self.site, *state, now_ns), replica.wanted.number, replica.facts

        info, decided, facts = self.run(described)
        try:
            with self.location.reader() as reader:
                epoch = reader.state().epoch
                identity, progress = reader.identity(), Progress(reader.watermarks())
                accepted = {event.body["store"] for event in reader.events(ACCEPTED)}
                past.checkpoints.look(past.depends_on(reader, facts), past.trusted_row(reader))
                shortfalls = [Shortfall.from_event(event) for event in reader.events(shortfall.KIND)]
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None
        with self._lock:
            counters = dict(self._counts)
        return info | {
            "epoch": epoch,
            "replica": "unknown",  # known to the server
            "descends": list(identity.descends),
            "accepted": sorted(accepted),
            "decided": decided,
            "journalled": self._following.journalled,
            "snapshot": max(snapshot_rows(self.location.folder), default=0),
            "machines": by_machine(progress, shortfalls),
            "shortfalls": [str(each) for each in shortfalls],
            "counters": counters,
        }

    def alive(self) -> ServerAlive:
        """Whether the journal is read; QueryError if not for long."""
        store, merged = self.run(lambda replica: (replica.version.store, replica.merged))
        _, behind_s = self._following.behind()
        if behind_s > HANGS_S:
            problem = f"the map has not had all rows of the journal for {behind_s:.0f} s; look at the follower's log"
            raise QueryError(Refusal.STORE, problem)
        return ServerAlive(store, self._following.journalled, merged, 0.0)

    def origin(self) -> Origin:
        """Names this follower; QueryError without a map."""
        rows, seconds = self._following.behind()
        if seconds == float("inf"):
            raise QueryError(Refusal.NOT_HERE, "this follower has no map yet; ask the map server")
        return Origin(self.name, rows, round(seconds, 3))

    def count(self, what: str) -> None:
        """Count a query's outcome."""
        with self._lock:
            self._counts[what] += 1


def _only_at_the_server(what: str) -> NoReturn:
    raise QueryError(Refusal.NOT_HERE, f"a follower does not know {what}; ask the map server")
