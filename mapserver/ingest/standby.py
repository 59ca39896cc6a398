"""A grid that follows the journal that another server writes, so that a take-over finds it warm."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import Decisions
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.history import History, fold_samples, pieces, read_history, release_memory
from mapserver.journal.journal import JournalQueries, JournalReader, JournalState
from mapserver.journal.location import JournalLocation
from mapserver.journal.records import last_checksum
from mapserver.journal.rows import JournalRows, Selection
from mapserver.past.past import StorePast
from protocol.errors import StoreError
from protocol.site.site_config import SiteConfig

log = logging.getLogger("mapserver.ingest.standby")
_NOTHING = JournalState(0, 0, 0)
_NO_ROW = -1  # a checksum of none
_PAUSE_S, _MOST_PAUSE_S = 0.1, 5.0  # after rows that cannot be read; doubled, since reading up to them takes its time


class Standby:
    """The map of a journal that another server writes. row: the last one in the grid."""

    def __init__(
        self, location: JournalLocation, site: SiteConfig, config: ServerConfig, check: Callable[[bool], object]
    ) -> None:
        """check: is called before each wait, with whether the grid is warm; what it raises ends the wait."""
        self._location, self._site, self._config, self._check = location, site, config, check
        self._reader: JournalReader | None = None
        self._is_checked, self._problem = False, ""
        self._again_s, self._pause_s = 0.0, _PAUSE_S
        self._begin(NO_FACTS)

    def follow(self, timeout_s: float) -> None:
        """Wait for more rows for so long at most, and have them in the grid."""
        began_s = time.monotonic()
        self._check(self._known != _NOTHING)
        if began_s < self._again_s:
            time.sleep(timeout_s)
            return
        try:
            reader = self._opened()
            state = reader.follow(self._known, timeout_s)
            if state != self._known:
                self._take(reader, state)
            self._problem, self._pause_s = "", _PAUSE_S
        except StoreError as error:  # the database is away, as while its replica is promoted, or a row is damaged
            if str(error) != self._problem:
                log.warning("standby cannot read problem=%r", str(error))
            self._problem, self._again_s = str(error), time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, _MOST_PAUSE_S)

    def has_checked(self, journal: JournalQueries) -> bool:
        """Whether this is the journal that was checked before its rows were folded."""
        return self._is_checked and self.row > 0 and self._is_in(journal, journal.last_row)

    def grid_for(self, journal: JournalQueries, facts: Facts) -> tuple[int, Grid] | None:
        """The grid and its last row, if the journal has the rows that it was made of, and these facts."""
        if facts != self._facts or not self.row or not self._is_in(journal, journal.last_row):
            return None
        return self.row, self._grid

    def close(self) -> None:
        """Close the reader."""
        if self._reader:
            self._reader.close()

    def _opened(self) -> JournalReader:
        if self._reader is None:
            self._reader = self._location.reader()
        if not self._is_checked:
            self._reader.check()  # here, where nobody waits for it
            self._is_checked = True
        return self._reader

    def _begin(self, facts: Facts) -> None:
        self.row, self._checksum, self._facts, self._known = 0, _NO_ROW, facts, _NOTHING
        self._grid = Grid(self._site.cell_m, self._config.fold)

    def _take(self, reader: JournalReader, state: JournalState) -> None:
        """Fold what there is beyond the grid, which is begun anew where the journal has other facts or rows."""
        is_same = self._is_in(reader, state.row)
        is_decided = state.event != self._known.event or not is_same
        facts = Decisions.of_journal(reader).facts if is_decided else self._facts
        if not is_same:
            self._is_checked = False  # it was restored, or another server has it
        if facts != self._facts or not is_same:
            log.info("standby folds again row=%d fact=%d", state.row, facts.number)
            self._begin(facts)
        if not self.row:
            self._load(reader, facts)
        if state.row > self.row:
            self._fold(_Reading(History(reader, self._location.archive), self.row, state.row), facts)
        self._known = state

    def _fold(self, reading: _Reading, facts: Facts) -> None:
        """Fold rows as far as they can be read: what is in the grid is in it once, whatever follows."""
        selection, rows = Selection.by(facts), reading.rows(facts.excluded)
        if self._known == _NOTHING:
            fold_samples(self._grid, pieces(rows, selection))
            release_memory()
        else:
            for some in rows:
                self._grid.fold_all(*some.selected(selection))
        if reading.row > self.row:
            self.row, self._checksum = reading.row, reading.checksum
        if reading.problem:
            raise reading.problem

    def _load(self, reader: JournalReader, facts: Facts) -> None:
        """Begin with a snapshot of this server's folder, if it is of this journal."""
        location = self._location
        past = StorePast.of_store(location.folder, self._site.cell_m, self._config.fold, location.trusted_row)
        self.row, self._grid = past.newest(reader, facts)
        self._checksum = reader.row_checksum(self.row) or _NO_ROW

    def _is_in(self, journal: JournalQueries, last_row: int) -> bool:
        """Whether the journal still has the last row of the grid, and not another one of its number."""
        return self.row <= last_row and (
            self.row <= journal.archived_row or journal.row_checksum(self.row) == self._checksum
        )


class _Reading:
    """Rows after < row <= until of a history, up to the first that cannot be read.

    row, checksum: of the last one that was. problem: why there was no further one.
    """

    def __init__(self, history: History, after: int, until: int) -> None:
        self._history, self._until = history, until
        self.row, self.checksum = after, 0
        self.problem: StoreError | None = None

    def rows(self, without: frozenset[str]) -> Iterator[JournalRows]:
        """Those of all other machines."""
        try:
            for rows in read_history(self._history, self.row, self._until):
                self.row, self.checksum = int(rows.numbers[-1]), last_checksum(rows)
                yield rows.without(without)
        except StoreError as error:
            self.problem = error
