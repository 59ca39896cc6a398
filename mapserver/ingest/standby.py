"""A grid that follows the journal that another server writes, so that a take-over finds it warm."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from mapserver.config import ServerConfig
from mapserver.evidence import snapshot
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import Decisions
from mapserver.journal.facts import NO_FACTS, Facts
from mapserver.journal.history import History, read_history
from mapserver.journal.journal import JournalQueries, JournalReader, JournalState
from mapserver.journal.location import JournalLocation
from mapserver.journal.refold import fold_history, release_memory
from mapserver.journal.rows import Selection
from protocol.errors import StoreError
from protocol.site.site_config import SiteConfig

log = logging.getLogger("mapserver.ingest.standby")
_NOTHING = JournalState(0, 0, 0)


class Standby:
    """The map of a journal that another server writes. row: the last one in the grid."""

    def __init__(
        self, location: JournalLocation, site: SiteConfig, config: ServerConfig, check: Callable[[bool], object]
    ) -> None:
        """check: is called before each wait, with whether the grid is warm; what it raises ends the wait."""
        self._location, self._site, self._config, self._check = location, site, config, check
        self._reader: JournalReader | None = None
        self._known = _NOTHING
        self._problem = ""
        self._begin(NO_FACTS)

    def follow(self, timeout_s: float) -> bool:
        """Wait until there are more rows, for so long at most, and have them in the grid.

        Whether the journal was checked as who opens it does.
        """
        began_s = time.monotonic()
        self._check(self._known != _NOTHING)
        if began_s < self._again_s:
            time.sleep(timeout_s)
            return False
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
        return self._is_checked

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
        self.row, self._checksum, self._facts, self._known = 0, None, facts, _NOTHING
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
        self._fold(_Rows(History(reader, self._location.archive), self.row, state.row), facts)
        self._known = state

    def _fold(self, rows: _Rows, facts: Facts) -> None:
        """Fold rows as far as they can be read: what is in the grid is in it once, whatever follows."""
        selection = Selection.by(facts)
        if self._known == _NOTHING:
            fold_samples(self._grid, pieces(rows.but(facts.excluded), selection))
            release_memory()
        else:
            for some in rows.but(facts.excluded):
                self._grid.fold_all(*some.selected(selection))
        self.row, self._checksum = rows.row, rows.checksum if rows.checksum is not None else self._checksum
        if rows.problem:
            raise rows.problem

    def _load(self, reader: JournalReader, facts: Facts) -> None:
        """Begin with a snapshot of this server's folder, if it is of this journal."""
        folder, last_row = self._location.folder, self._location.trusted_row(reader)
        config = self._config.fold
        self.row, self._grid = snapshot.load_newest(folder, last_row, self._site.cell_m, config, facts.of_evidence())
        self._checksum = reader.row_checksum(self.row)

    def _is_in(self, journal: JournalQueries, last_row: int) -> bool:
        """Whether the journal still has the last row of the grid, and not another one of its number."""
        return self.row <= last_row and (
            self.row <= journal.archived_row or journal.row_checksum(self.row) == self._checksum
        )


class _Rows:
    """Rows after < row <= until of a history, up to the first that cannot be read.

    row, checksum: of the last one that was, None before there is one. problem: why it was the last.
    """

    def __init__(self, history: History, after: int, until: int) -> None:
        self.row, self.checksum, self.problem = after, None, None
        ...
