"""Decisions about machines: stored in the journal, then the map is rebuilt with the resulting facts.

The writer's thread owns the grid, so the new map is folded on another thread (`fold_anew`); the writer folds the few
remaining rows and swaps.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from mapserver.calibration.calibrate import Solution
from mapserver.calibration.correction import Correction, SampleCorrections
from mapserver.calibration.decision import CalibrationDecision
from mapserver.evidence.grid import Grid
from mapserver.ingest.decisions import Decisions, MachineDecision
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.facts import Facts
from mapserver.journal.history import release_memory
from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.past.past import StorePast, fold_anew
from mapserver.trust.auditor import Verdict
from mapserver.trust.decisions import TrustDecision
from protocol.errors import QueryError, Refusal, SitegridError

RETRY_S, MOST_RETRY_S = 1.0, 60.0  # pause after unreadable rows; doubles, as a fold may take minutes
T = TypeVar("T")
log = logging.getLogger("mapserver.upkeep.refolding")


class Refolding:
    """Decisions about machines, and the thread that rebuilds the map. Thread-safe."""

    def __init__(self, writer: Writer, past: StorePast) -> None:
        self._writer, self._past = writer, past
        self._reader = writer.location.reader()
        self._decisions = Decisions.of_journal(self._reader)
        self._wanted = self._decisions.facts
        self._changed = threading.Condition()  # its holder never waits for the writer, which takes it
        self._decided = self._folded = 0  # decisions stored since the start, and those in the map
        self._gave_up = False  # the last fold, for another
        self._problem = ""  # of the last fold, until one succeeds
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="refold", daemon=True)
        self._thread.start()

    def facts(self) -> Facts:
        """The map's facts."""
        return self._writer.run(lambda store: store.facts)

    def distrusted(self) -> frozenset[str]:
        """Machines excluded by decisions, possibly still in the map."""
        with self._changed:
            return self._decisions.trust.distrusted

    def decision(self, machine: str) -> TrustDecision | None:
        """The newest trust decision about a machine."""
        with self._changed:
            return self._decisions.trust.newest(machine)

    def corrections(self) -> SampleCorrections:
        """Decided corrections, also of excluded machines."""
        with self._changed:
            return self._decisions.calibration.corrections

    def solver_corrections(self) -> list[Correction]:
        """Newest correction of each machine by the solver."""
        with self._changed:
            return self._decisions.calibration.of_solver()

    def shown(self) -> list[Correction]:
        """Last correction of each machine with a scale from evidence."""
        with self._changed:
            return self._decisions.calibration.shown()

    def calibration(self, machine: str) -> CalibrationDecision | None:
        """The newest calibration decision about a machine."""
        with self._changed:
            return self._decisions.calibration.newest(machine)

    def judge(self, verdicts: Mapping[str, Verdict], stamp_ns: int) -> None:
        """Store the audit's decisions, if exclusion is on.

        QueryError as `decide`; the audit then repeats its decision.
        """
        if self._writer.config.trust.exclude:
            write(self._writer, lambda store: self._judge(store, verdicts, stamp_ns))

    def calibrate(self, solved: Solution, stamp_ns: int, *, asked: bool = False) -> int:
        """Store the solver's decisions, or all that a person asks for; returns a number to wait for.

        The solver waits while the map lags behind decisions. QueryError as `decide`; the solver then repeats its
        decision.
        """
        return write(self._writer, lambda store: self._calibrate(store, solved, stamp_ns, asked=asked))

    def decide(self, decision: MachineDecision) -> int:
        """Store a decision and have the map rebuilt; returns its number, to wait for.

        QueryError if it cannot be written: nothing changes, unless the error says that this is unknown.
        """
        return write(self._writer, lambda store: self._keep(store, [decision]))

    def wait(self, number: int, wait_s: float) -> None:
        """Wait until a stored decision is in the map; QueryError after wait_s."""
        with self._changed:
            self._changed.wait_for(lambda: self._folded >= number or self._ending, wait_s)
            if self._folded >= number:
                return
            why = "the server is stopping" if self._ending else f"the map is not folded again after {wait_s:g} s"
            problem = f"the decision is kept, but {why}" + (f": {self._problem}" if self._problem else "")
        raise QueryError(Refusal.AFTER_TIMEOUT, f"{problem}; ask for `machines`")

    def close(self) -> None:
        """End the thread; the next start repeats a cancelled fold."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        self._reader.close()

    def _judge(self, store: Store, verdicts: Mapping[str, Verdict], stamp_ns: int) -> None:
        with self._changed:
            decisions = self._decisions.trust.judge(verdicts, stamp_ns)
        self._keep(store, decisions)

    def _calibrate(self, store: Store, solved: Solution, stamp_ns: int, *, asked: bool) -> int:
        with self._changed:
            decisions = self._decisions.calibration.judge(solved, stamp_ns, asked=asked)
            waits = not asked and self._folded < self._decided
            store.confirm(self._decisions.calibration.confirmed)
        return self._keep(store, () if waits else decisions)

    def _keep(self, store: Store, decisions: Sequence[MachineDecision]) -> int:
        """Store decisions; returns their number since the start."""
        facts = store.decide(*decisions) if decisions else None
        for decision in decisions:
            _log(decision)
        with self._changed:
            if facts:
                self._decisions.add(decisions, facts.number)
                self._wanted = facts
                self._decided += len(decisions)
                self._changed.notify_all()
            return self._decided

    def _run(self) -> None:
        """Rebuild the map after decisions; those made meanwhile are combined."""
        retry_s = RETRY_S
        while decided := self._next():
            number, facts = decided
            follows, problem = self._attempt(facts)
            self._gave_up = not follows and not problem
            with self._changed:
                self._problem = problem
                if follows:
                    self._folded = number
                    self._changed.notify_all()
            retry_s = self._pause(number, retry_s) if problem else RETRY_S

    def _next(self) -> tuple[int, Facts] | None:
        """Wait for pending decisions: their number and facts."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or self._folded < self._decided)
            return None if self._ending else (self._decided, self._wanted)

    def _pause(self, number: int, retry_s: float) -> float:
        """Wait after a failed fold, or until another decision; returns the next pause."""
        with self._changed:
            self._changed.wait_for(lambda: self._ending or self._decided > number, retry_s)
        return min(2 * retry_s, MOST_RETRY_S)

    def _attempt(self, facts: Facts) -> tuple[bool, str]:
        """Whether the map follows, and the problem if not."""
        try:
            return self._follow(facts), ""
        except (SitegridError, OSError) as error:
            log.error("upkeep failed job=refolding error=%r", str(error))
            return False, str(error)
        except Exception:  # a bug must neither end the server nor go unnoticed
            log.exception("upkeep failed job=refolding")
            return False, "the server failed; see its log"

    def _follow(self, facts: Facts) -> bool:
        """Rebuild the map with these facts; False if superseded."""
        if facts == self.facts():
            return True
        began_s = time.monotonic()
        folded = fold_anew(self._past, self._reader, facts, lambda: self._superseded(facts))
        if folded is None:
            return False
        replaced: list[Grid] = []

        def adopt(store: Store) -> None:
            replaced.append(store.grid)
            store.adopt(folded.grid, folded.row, facts)

        self._writer.run(adopt)
        replaced.clear()  # here, because freeing a grid would delay the writer
        release_memory()
        values = (facts.number, ",".join(sorted(facts.excluded)), folded.rounds, time.monotonic() - began_s)
        log.warning("map folded again fact=%d without=%s rounds=%d seconds=%.1f", *values)
        return True

    def _superseded(self, facts: Facts) -> bool:
        """Whether other facts have superseded this fold.

        Never two in a row, or frequent decisions would starve the map.
        """
        return self._ending or (self._wanted != facts and not self._gave_up)


def write(writer: Writer, work: Callable[[Store], T]) -> T:
    """Store a decision on the writer's thread, one at a time, so memory and disk have the same order.

    QueryError as `Refolding.decide`.
    """
    try:
        return writer.run(work)
    except TimeoutError:  # an OSError, but the work is still queued
        problem = "the server has not written the decision yet, and may still do so; ask for `machines`"
        raise QueryError(Refusal.AFTER_TIMEOUT, problem) from None
    except FencedError as error:
        raise QueryError(Refusal.NOT_WRITER, f"the decision is not written: {error.problem}") from None
    except UnwrittenError as error:
        if error.unsure:
            problem = f"it is not known whether the decision is kept, since the answer is lost: {error.problem}"
            raise QueryError(Refusal.AFTER_TIMEOUT, f"{problem}; ask for `machines`") from None
        problem = f"the decision cannot be written, so it does not count: {error.problem}"
        raise QueryError(Refusal.STORE, f"{problem}; make room on the server's disk, then give it again") from None


def _log(decision: MachineDecision) -> None:
    if isinstance(decision, TrustDecision):
        values = (decision.machine, decision.trusted, decision.by, decision.reason)
        log.warning("trust machine=%s trusted=%s by=%s reason=%r", *values)
    else:
        spans = (decision.machine, len(decision.corrections), decision.by, decision.reason)
        log.info("calibration machine=%s spans=%d by=%s reason=%r", *spans)
