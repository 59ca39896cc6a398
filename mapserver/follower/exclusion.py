"""Exclusion of machines: decisions are kept with the journal, then the map is folded again without those excluded.

The grid belongs to the writer's thread. So a map without a machine is folded on a thread of its own, in rounds, each
with what came in during the one before; the writer folds what the last round left, a few rows, and goes on with it.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from typing import TypeVar

from mapserver.evidence.grid import Grid
from mapserver.ingest.store import JOURNAL_FILE, Store
from mapserver.ingest.writer import Writer
from mapserver.journal.history import History
from mapserver.journal.reader import JournalReader
from mapserver.journal.refold import fold_history, release_memory
from mapserver.journal.rows import Selection
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import KIND, TrustDecision, TrustDecisions
from protocol.errors import QueryError, Refusal, SitegridError

FEW_ROWS = 8  # may be left to the writer's thread: some ms
MOST_ROUNDS = 20  # where batches come in as fast as they are folded, the writer has to make them wait
RETRY_S, MOST_RETRY_S = 1.0, 60.0  # after rows that could not be read; doubled, as a fold up to them may take minutes
T = TypeVar("T")
log = logging.getLogger("mapserver.follower.exclusion")


class Exclusion:
    """Decisions about machines, and a thread that folds the map without those excluded. All of it is for any thread."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._reader = JournalReader(writer.folder / JOURNAL_FILE)
        self._decisions = TrustDecisions(self._reader.events(KIND))
        self._wanted = self._decisions.distrusted
        self._changed = threading.Condition()  # its holder never waits for the writer, which takes it
        self._decided = self._folded = 0  # decisions kept since the start, and so many of them that the map follows
        self._problem = ""  # of the last fold, until one succeeds
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="refold", daemon=True)
        self._thread.start()

    def excluded(self) -> frozenset[str]:
        """Machines whose rows are not in the map."""
        return self._writer.run(lambda store: store.excluded)

    def decision(self, machine: str) -> TrustDecision | None:
        """The newest decision about a machine that counts."""
        with self._changed:
            return self._decisions.newest(machine)

    def judge(self, verdicts: Mapping[str, Verdict], stamp_ns: int) -> None:
        """Decide what the audit may decide, which may be nothing: `machines` names its verdicts in any case.

        Raises QueryError as `decide` does; the audit then decides the same the next time.
        """
        if self._writer.config.trust.exclude:
            self._write(lambda store: self._judge(store, verdicts, stamp_ns))

    def decide(self, decision: TrustDecision) -> int:
        """Keep a decision on disk, then have the map folded so; returns its number, to wait for.

        Raises QueryError where it cannot be written: nothing has changed then.
        """
        return self._write(lambda store: self._keep(store, decision))

    def wait(self, number: int, wait_s: float) -> None:
        """Wait until a decision, which is kept, counts in the map; QueryError after wait_s."""
        with self._changed:
            self._changed.wait_for(lambda: self._folded >= number or self._ending, wait_s)
            if self._folded >= number:
                return
            why = "the server is stopping" if self._ending else f"the map is not folded again after {wait_s:g} s"
            problem = f"the decision is kept, but {why}" + (f": {self._problem}" if self._problem else "")
        raise QueryError(Refusal.AFTER_TIMEOUT, f"{problem}; ask for `machines`")

    def close(self) -> None:
        """End the thread; a fold is given up, and the next start makes it."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        self._reader.close()

    def _write(self, work: Callable[[Store], T]) -> T:
        """Have work done on the writer's thread, one at a time: what is in memory is what is on disk, in its order."""
        try:
            return self._writer.run(work)
        except TimeoutError:  # an OSError, but the work still waits
            problem = "the server has not written the decision yet, and may still do so; ask for `machines`"
            raise QueryError(Refusal.AFTER_TIMEOUT, problem) from None
        except (sqlite3.Error, OSError) as error:
            problem = f"the decision cannot be written, so it does not count: {error}"
            raise QueryError(Refusal.STORE, f"{problem}; make room on the server's disk, then give it again") from None

    def _judge(self, store: Store, verdicts: Mapping[str, Verdict], stamp_ns: int) -> None:
        with self._changed:
            decisions = self._decisions.judge(verdicts, stamp_ns)
        for decision in decisions:
            self._keep(store, decision)

    def _keep(self, store: Store, decision: TrustDecision) -> int:
        store.decide(decision)
        values = (decision.machine, decision.trusted, decision.by, decision.reason)
        log.warning("trust machine=%s trusted=%s by=%s reason=%r", *values)
        with self._changed:
            self._decisions.add(decision)
            self._wanted = self._decisions.distrusted
            self._decided += 1
            self._changed.notify_all()
            return self._decided

    def _run(self) -> None:
        """Have the map follow the decisions; those that were made in the meantime are followed together."""
        retry_s = RETRY_S
        while decided := self._next():
            number, excluded = decided
            follows, problem = self._attempt(excluded)
            with self._changed:
                self._problem = problem
                if follows:
                    self._folded = number
                    self._changed.notify_all()
            retry_s = self._pause(number, retry_s) if problem else RETRY_S

    def _next(self) -> tuple[int, frozenset[str]] | None:
        """Wait for decisions that the map does not follow yet: how many there are, and whom they leave out."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or self._folded < self._decided)
            return None if self._ending else (self._decided, self._wanted)

    def _pause(self, number: int, retry_s: float) -> float:
        """Wait after a fold that failed, unless something else is decided; returns how long the next time."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or self._decided > number, retry_s)
        return min(2 * retry_s, MOST_RETRY_S)

    def _attempt(self, excluded: frozenset[str]) -> tuple[bool, str]:
        """Whether the map follows, and what keeps it from that."""
        try:
            return self._follow(excluded), ""
        except (SitegridError, OSError) as error:
            log.error("follower failed job=exclusion error=%r", str(error))
            return False, str(error)
        except Exception:  # a bug here must not end the server, nor pass unseen
            log.exception("follower failed job=exclusion")
            return False, "the server failed; see its log"

    def _follow(self, excluded: frozenset[str]) -> bool:
        """Have a map without these machines; whether it is there, else it is to be another one meanwhile."""
        if excluded == self.excluded():
            return True
        began_s = time.monotonic()
        grid, row, rounds = Grid(self._writer.site.cell_m, self._writer.config.fold), 0, 0
        history, selection = History.beside(self._reader), Selection(without=excluded)
        while (last := self._reader.last_row) - row > FEW_ROWS and rounds < MOST_ROUNDS:
            if not fold_history(grid, history, row, last, selection, lambda: self._superseded(excluded)):
                return False
            row, rounds = last, rounds + 1
        replaced: list[Grid] = []

        def adopt(store: Store) -> None:
            replaced.append(store.grid)
            store.adopt(grid, row, excluded)

        self._writer.run(adopt)
        replaced.clear()  # here: to let go of a grid takes time that the writer's thread does not have
        release_memory()
        values = (",".join(sorted(excluded)), rounds, time.monotonic() - began_s)
        log.warning("map folded again without=%s rounds=%d seconds=%.1f", *values)
        return True

    def _superseded(self, excluded: frozenset[str]) -> bool:
        """Whether what is being folded is not wanted any more."""
        return self._ending or self._wanted != excluded
