"""A replica that follows another server's journal, for a warm take-over."""

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
    """See `Waiting`; it turns while it waits for the journal."""

    def __init__(
        self, location: JournalLocation, site: SiteConfig, config: ServerConfig, check: Callable[[bool], object]
    ) -> None:
        """check: called before waits, with whether the grid is warm; its exceptions end them."""
        super().__init__(location, site, config)
        self._check = check

    def follow(self, timeout_s: float) -> None:
        """Wait up to a timeout for rows, and fold them."""
        self._check(self._is_whole)
        self.turn(timeout_s)

    def has_checked(self, journal: JournalQueries) -> bool:
        """Whether this is the journal that was checked before its rows were folded."""
        return self._replica is not None and self._replica.merged > 0 and self._replica.tail.is_in(journal)

    def grid_for(self, journal: JournalQueries, facts: Facts) -> tuple[int, Grid] | None:
        """The grid and its last row, if they match journal and facts."""
        if self._anew and self._anew[0] == facts:  # ahead of any other
            wait([self._anew[1]])
            self.turn(0.0)
        replica = self._replica
        if not replica or not self.has_checked(journal) or replica.facts != facts:
            return None
        return replica.merged, replica.grid

    def _begun(self, reader: JournalReader) -> Replica:
        reader.check()  # here, where nobody waits
        return super()._begun(reader)
