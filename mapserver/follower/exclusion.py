"""Exclusion of machines: decisions are kept with the journal, then the map is folded again without those excluded.

The grid belongs to the writer's thread. So a map without a machine is folded here from all rows, then handed to the
writer, which folds what came in meanwhile and goes on with it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping

from mapserver.evidence.grid import REFOLD_ROWS, Grid
from mapserver.ingest.writer import Writer
from mapserver.journal.history import History, history_rows
from mapserver.journal.reader import JournalReader
from mapserver.journal.rows import Selection
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import KIND, TrustDecision, TrustDecisions

log = logging.getLogger("mapserver.follower.exclusion")


class Exclusion:
    """Decisions about machines, and which of them the map is folded without. All but `run` are for any thread."""

    name = "exclusion"

    def __init__(self, writer: Writer, reader: JournalReader, ending: threading.Event) -> None:
        self._writer, self._reader, self._ending = writer, reader, ending
        self._decisions = TrustDecisions(reader.events(KIND))
        self._requested: list[TrustDecision] = []
        self._unfolded: list[TrustDecision] = []  # kept with the journal, but not in the map yet
        self._changed = threading.Condition()

    @property
    def requested(self) -> bool:
        """Whether a decision waits for the next run."""
        return bool(self._requested)

    def excluded(self) -> frozenset[str]:
        """Machines whose rows are not in the map."""
        return self._writer.run(lambda store: store.excluded)

    def decision(self, machine: str) -> TrustDecision | None:
        """The newest decision about a machine that counts."""
        with self._changed:
            return self._decisions.newest(machine)

    def judge(self, verdicts: Mapping[str, Verdict], stamp_ns: int) -> None:
        """Have decided what the audit may decide, which may be nothing: `machines` names its verdicts in any case."""
        with self._changed:
            if self._writer.config.trust.exclude:
                self._requested += self._decisions.judge(verdicts, stamp_ns)

    def request(self, decision: TrustDecision) -> None:
        """Have a decision made."""
        with self._changed:
            self._requested.append(decision)

    def wait(self, decision: TrustDecision, wait_s: float) -> bool:
        """Whether a decision counts in the map, after waiting for it."""
        with self._changed:
            return self._changed.wait_for(lambda: decision not in self._requested + self._unfolded, wait_s)

    def run(self) -> None:
        """Keep what was decided, fold the map again where that changes who is excluded, tell who waits."""
        for decision in list(self._requested):
            self._keep(decision)
        if not self._unfolded:
            return
        if self._decisions.distrusted != self.excluded():
            self._fold_again(self._decisions.distrusted)
        with self._changed:
            self._unfolded.clear()
            self._changed.notify_all()

    def _keep(self, decision: TrustDecision) -> None:
        self._writer.run(lambda store: store.decide(decision))
        values = (decision.machine, decision.trusted, decision.by, decision.reason)
        log.warning("trust machine=%s trusted=%s by=%s reason=%r", *values)
        with self._changed:
            self._decisions.add(decision)
            self._requested.remove(decision)
            self._unfolded.append(decision)

    def _fold_again(self, excluded: frozenset[str]) -> None:
        until = self._reader.last_row
        grid = Grid(self._writer.site.cell_m, self._writer.config.fold, REFOLD_ROWS)
        for row in history_rows(History.beside(self._reader), until=until, selection=Selection(without=excluded)):
            grid.fold(row.rows, row.machine)
            if self._ending.is_set():
                return
        self._writer.run(lambda store: store.adopt(grid, until, excluded))
