"""The job that calibrates machines: follows the samples, solves now and then in site time, and has the result decided.

What it remembers are the ledgers of the machines. A server that starts makes them anew, from the journal and archive of
the last days.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from mapserver.evidence.fold_config import is_foldable
from mapserver.fleet.calibration import Calibration, calibrate, epochs_of_each, groups, joined
from mapserver.fleet.correction import Correction
from mapserver.fleet.ledger import Ledger
from mapserver.fleet.machine_state import MachineState, remembered_of
from mapserver.ingest.writer import Writer
from mapserver.journal.rows import JournalRows, Selection
from mapserver.past.past import Past
from mapserver.past.plan import DAY_NS
from protocol.errors import StoreError
from protocol.machine.samples import RAW_SAMPLE, SAMPLE_DTYPE

DAYS = 2  # of samples, which hold the hours of driving that a ledger remembers of a machine at work
EVERY_NS = 60 * 10**9  # of site time, between two solves: a fifth of an epoch
REST = 50.0  # times as long as a solve took: 2 % of a core, also where a log is replayed
TURN_SAMPLES = 200_000  # read in one turn, in about 0.2 s
Decide = Callable[[Calibration, int], object]
Group = tuple[str, ...]
log = logging.getLogger("mapserver.upkeep.calibrating")


class Calibrating:
    """Ledgers of all machines, and what they come to. solved: the last solve, and the site's now then [ns].

    decide: is given each solve and the site's now [ns]. doubtful: machines that are to have no say now. earlier: the
    newest corrections that the solver decided.
    """

    name = "calibration"

    def __init__(
        self,
        writer: Writer,
        past: Past,
        decide: Decide,
        doubtful: Callable[[], frozenset[str]],
        earlier: Callable[[], Iterable[Correction]],
        ending: threading.Event,
    ) -> None:
        self.solved: tuple[Calibration, int] = calibrate({}), 0
        self._writer, self._past, self._decide, self._doubtful, self._ending = writer, past, decide, doubtful, ending
        self._earlier = earlier
        self._reader = writer.location.reader()
        self._ledgers: dict[str, Ledger] = {}
        self._begins_ns: dict[str, int] = {}  # by machine, from when on there may be samples of it
        self._followed = 0
        self._passed_over = 0  # rows that could not be read, at the next attempt
        self._parts: dict[Group, Calibration] = {}  # the last solve of each group
        self._next = -1  # of the groups
        self._from_ns: int | None = None  # of samples that are read: until it has caught up, those of the last days
        self._solved_ns = self._now_ns()  # or the start: what was known by then is decided already
        self._due_s = 0.0
        self._turn = threading.Lock()  # of all that is used here: `solve` is for any thread

    def states(self) -> Mapping[str, MachineState]:
        """What the last solve says of machines, by name."""
        return self.solved[0].machines

    def run(self) -> None:
        """Follow the journal; where that is done and it is time, solve the next group, and have it decided."""
        with self._turn:
            if not self._follow(TURN_SAMPLES) or time.monotonic() < self._due_s:
                return
            now_ns = self._now_ns()
            if self._solved_ns <= now_ns < self._solved_ns + EVERY_NS:
                return
            together = groups(self._ledgers)
            self._next = (self._next + 1) % len(together)
            solved = self._solve(together[self._next], together, now_ns)
            if self._writer.config.calibration.automatic and not self._ending.is_set():
                self._decide(solved, now_ns)

    def solve(self) -> tuple[Calibration, int]:
        """Solve with all that is journalled by now; what came out, and the site's now [ns]. For any thread."""
        with self._turn:
            while not self._follow(TURN_SAMPLES) and not self._ending.is_set():
                pass
            now_ns = self._now_ns()
            together = groups(self._ledgers)
            for some in together:
                if not self._ending.is_set():
                    self._solve(some, together, now_ns)
            return self.solved

    def close(self, wait_s: float = 0.0) -> None:
        """Close the journal. A solve that takes longer ends with the process: what it says is of no use any more."""
        if self._turn.acquire(timeout=wait_s):
            self._reader.close()  # and keep the turn: nothing runs any more

    def _now_ns(self) -> int:
        return self._writer.run(lambda store: store.newest_ns)

    def _solve(self, names: Group, together: Sequence[Group], now_ns: int) -> Calibration:
        """Solve one group of machines; what it says. together: all groups."""
        began_s, self._solved_ns = time.thread_time(), now_ns
        try:
            stays = {name: self._ledgers[name].stays() for name in names}
            remembered = remembered_of(self._earlier())
            solved = calibrate(stays, self._doubtful(), self._writer.site.known_ground, remembered)
            solved = replace(solved, begins_ns={name: self._begins_ns[name] for name in names})
            self._parts = {some: part for some, part in self._parts.items() if some in together} | {names: solved}
            self.solved = joined([*self._parts.values()]), now_ns
        finally:
            took_s = time.thread_time() - began_s
            self._due_s = time.monotonic() + REST * took_s
        values = (len(names), len(self._ledgers), took_s, solved.common.observed, solved.common.reason)
        log.info("calibration solved machines=%d of=%d seconds=%.2f common_scale=%s reason=%s", *values)
        return solved

    def _follow(self, most: int) -> bool:
        """Take about so many samples into the ledgers; whether all are in that there were.

        Where rows cannot be read, it goes on behind them the next time, as far as it takes: evidence that is missing
        makes corrections less sure, not wrong.
        """
        if self._from_ns is None:
            self._from_ns = max(0, self._now_ns() - DAYS * DAY_NS)
        until, taken = self._reader.last_row, 0
        self._followed = min(self._followed + self._passed_over, until)
        try:
            for rows in self._past.rows(self._reader, Selection(from_ns=self._from_ns), self._followed, until):
                self._passed_over = 0
                self._followed = int(rows.numbers[-1])  # first: what fails is not taken twice
                self._add(rows)
                taken += len(rows.samples)
                if taken >= most or self._ending.is_set():
                    return False
        except (StoreError, OSError) as error:
            self._passed_over = max(1, 2 * self._passed_over)
            log.error(
                "calibration passes over rows=%d after=%d error=%r", self._passed_over, self._followed, str(error)
            )
            return False
        self._followed, self._from_ns, self._passed_over = until, 0, 0  # what is late from now on is of interest
        return True

    def _add(self, rows: JournalRows) -> None:
        machine = np.repeat(rows.machine, rows.lengths)
        machine[~is_foldable(rows.samples, self._past.config)] = -1
        for index, name in enumerate(rows.machines):
            own = rows.samples.view(RAW_SAMPLE)[machine == index].view(SAMPLE_DTYPE)
            if not len(own):
                continue
            if name not in self._ledgers:
                self._ledgers[name] = Ledger()
                self._share_room()
            first_ns = 0 if self._from_ns else int(own["stamp_ns"].min())  # what was before the last days is not read
            self._begins_ns[name] = min(first_ns, self._begins_ns.get(name, first_ns))
            self._ledgers[name].add(own)

    def _share_room(self) -> None:
        """Have each ledger remember what a solve of so many machines takes, and no more."""
        epochs = epochs_of_each(len(self._ledgers))
        for ledger in self._ledgers.values():
            if epochs < ledger.epochs:
                ledger.epochs = epochs
                log.info("calibration machines=%d epochs=%d: a solve takes no more", len(self._ledgers), epochs)
