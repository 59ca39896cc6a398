"""A replica that may be promoted: it follows the journal that another server writes, so that a take-over is warm."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import wait

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.following import Following
from mapserver.ingest.replica import Replica
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalQueries, JournalReader
from mapserver.journal.location import JournalLocation
from protocol.site.site_config import SiteConfig


class Standby(Following):
    """See `Waiting`: its turns are those of who waits for the journal."""

    def __init__(
        self, location: JournalLocation, site: SiteConfig, config: ServerConfig, check: Callable[[bool], object]
    ) -> None:
        """check: is called before each wait, with whether the grid is warm; what it raises ends the wait."""
        super().__init__(location, site, config)
        self._check = check

    def follow(self, timeout_s: float) -> None:
        """Wait for more rows for so long at most, and have them in the grid."""
        self._check(self._is_whole)
        self.turn(timeout_s)

    def has_checked(self, journal: JournalQueries) -> bool:
        """Whether this is the journal that was checked before its rows were folded."""
        return self._replica is not None and self._replica.merged > 0 and self._replica.tail.is_in(journal)

    def grid_for(self, journal: JournalQueries, facts: Facts) -> tuple[int, Grid] | None:
        """The grid and its last row, if the journal has the rows that it was made of, and these facts."""
        if self._anew and self._anew[0] == facts:  # it began before any other would
            wait([self._anew[1]])
            self.turn(0.0)
        replica = self._replica
        if not replica or not self.has_checked(journal) or replica.facts != facts:
            return None
        return replica.merged, replica.grid

    def _begun(self, reader: JournalReader) -> Replica:
        reader.check()  # here, where nobody waits for it
        return super()._begun(reader)
