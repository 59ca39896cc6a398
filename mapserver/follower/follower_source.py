"""The map of a process that follows, as queries are answered from it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

from mapserver.evidence.snapshot import rows_on_disk
from mapserver.follower.following import Following
from mapserver.follower.replica import Replica
from mapserver.ingest.losses import by_machine
from mapserver.ingest.map_info import map_info
from mapserver.ingest.store import ACCEPTED
from mapserver.journal import shortfall
from mapserver.journal.facts import Facts
from mapserver.journal.progress import Progress
from mapserver.journal.shortfall import Shortfall
from mapserver.past.past import Past
from protocol.errors import QueryError, Refusal, StoreError
from protocol.queries.answers import GroundChange, ServerAlive
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.origin import Origin

HANGS_S = 30.0  # without a look at the journal, which takes place every second
T = TypeVar("T")


class FollowerSource:
    """See `MapSource`. Only the server knows what its audit and its solver found: it is asked for that."""

    def __init__(self, name: str, following: Following, now_ns: Callable[[], int]) -> None:
        self.name, self._following, self._now_ns = name, following, now_ns
        self.site, self.config, self.location = following.site, following.config, following.location
        self.waits = following.waits
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def past(self) -> Past:
        """See `Following`."""
        return self._following.past

    def run(self, work: Callable[[Replica], T]) -> T:
        """See `Following`."""
        return self._following.run(work)

    def changes(self, after: int) -> list[GroundChange]:
        """Those that the server has found, and the follower has read."""
        known = self.run(lambda replica: sorted(replica.changes.items()))
        return [change for number, change in known if number > after]

    def machines(self) -> list[dict[str, Any]]:
        """Not here."""
        _only_at_the_server("what the audit of machines found")

    def calibration(self) -> CalibrationAnswer:
        """Not here."""
        _only_at_the_server("what is known of calibrations")

    def info(self) -> dict[str, Any]:
        """As the server's, of this process; what the journal alone tells is read from it."""
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
            "replica": "unknown",  # the server knows
            "descends": list(identity.descends),
            "accepted": sorted(accepted),
            "decided": decided,
            "journalled": self._following.journalled,
            "snapshot": max(rows_on_disk(self.location.folder), default=0),
            "machines": by_machine(progress, shortfalls),
            "shortfalls": [str(each) for each in shortfalls],
            "counters": counters,
        }

    def alive(self) -> ServerAlive:
        """Whether the journal is looked at; QueryError where it has not been for long."""
        store, merged = self.run(lambda replica: (replica.store, replica.merged))
        _, behind_s = self._following.behind()
        if behind_s > HANGS_S:
            problem = f"the map has not had all rows of the journal for {behind_s:.0f} s; look at the follower's log"
            raise QueryError(Refusal.STORE, problem)
        return ServerAlive(store, self._following.journalled, merged, 0.0)

    def origin(self) -> Origin:
        """Who answers is this follower; QueryError while it has no map."""
        rows, seconds = self._following.behind()
        if seconds == float("inf"):
            raise QueryError(Refusal.NOT_HERE, "this follower has no map yet; ask the map server")
        return Origin(self.name, rows, round(seconds, 3))

    def count(self, what: str) -> None:
        """Count what became of a query."""
        with self._lock:
            self._counts[what] += 1


def _only_at_the_server(what: str) -> NoReturn:
    raise QueryError(Refusal.NOT_HERE, f"a follower does not know {what}; ask the map server")
