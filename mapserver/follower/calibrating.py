"""The job that calibrates machines: follows the samples, solves now and then in site time, and has the result decided.

What it remembers are the ledgers of the machines. A server that starts makes them anew, from the journal and archive of
the last days.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from mapserver.evidence.fold_config import is_foldable
from mapserver.fleet.calibration import Calibration, MachineState, calibrate
from mapserver.fleet.ledger import Ledger
from mapserver.ingest.store import JOURNAL_FILE
from mapserver.ingest.writer import Writer
from mapserver.journal.reader import JournalReader
from mapserver.journal.rows import JournalRows, Selection
from mapserver.past.past import Past
from mapserver.past.plan import DAY_NS
from protocol.machine.samples import RAW_SAMPLE, SAMPLE_DTYPE

DAYS = 2  # of samples, which hold the hours of driving that a ledger remembers of a machine at work
EVERY_NS = 60 * 10**9  # of site time, between two solves: a fifth of an epoch
REST = 50.0  # times as long as a solve took: 2 % of a core, also where a log is replayed
TURN_SAMPLES = 200_000  # read in one turn, in about 0.2 s
Decide = Callable[[Calibration, int], object]
log = logging.getLogger("mapserver.follower.calibrating")


class Calibrating:
    """Ledgers of all machines, and what they come to. solved: the last solve, and the site's now then [ns].

    decide: is given each solve and the site's now [ns]. doubtful: machines that are to have no say now.
    """

    name = "calibration"

    def __init__(
        self,
        writer: Writer,
        past: Past,
        decide: Decide,
        doubtful: Callable[[], frozenset[str]],
        ending: threading.Event,
    ) -> None:
        self.solved: tuple[Calibration, int] = calibrate({}), 0
        self._writer, self._past, self._decide, self._doubtful, self._ending = writer, past, decide, doubtful, ending
        self._reader = JournalReader(writer.folder / JOURNAL_FILE)
        self._ledgers: dict[str, Ledger] = {}
        self._followed = 0
        self._from_ns: int | None = None  # of samples that are read: until it has caught up, those of the last days
        self._solved_ns = self._now_ns()  # or the start: what was known by then is decided already
        self._due_s = 0.0
        self._turn = threading.Lock()  # of all that is used here: `solve` is for any thread

    def states(self) -> Mapping[str, MachineState]:
        """What the last solve says of machines, by name."""
        return self.solved[0].machines

    def run(self) -> None:
        """Follow the journal; where that is done and it is time, solve, and have it decided."""
        with self._turn:
            if not self._follow(TURN_SAMPLES) or time.monotonic() < self._due_s:
                return
            now_ns = self._now_ns()
            if self._solved_ns <= now_ns < self._solved_ns + EVERY_NS:
                return
            solved = self._solve(now_ns)
            if self._writer.config.calibration.automatic and not self._ending.is_set():
                self._decide(solved, now_ns)

    def solve(self) -> tuple[Calibration, int]:
        """Solve with all that is journalled by now; what came out, and the site's now [ns]. For any thread."""
        with self._turn:
            while not self._follow(TURN_SAMPLES) and not self._ending.is_set():
                pass
            now_ns = self._now_ns()
            return (self.solved[0] if self._ending.is_set() else self._solve(now_ns)), now_ns

    def close(self, wait_s: float = 0.0) -> None:
        """Close the journal. A solve that takes longer ends with the process: what it says is of no use any more."""
        if self._turn.acquire(timeout=wait_s):
            self._reader.close()  # and keep the turn: nothing runs any more

    def _now_ns(self) -> int:
        return self._writer.run(lambda store: store.newest_ns)

    def _solve(self, now_ns: int) -> Calibration:
        began_s, self._solved_ns = time.thread_time(), now_ns
        try:
            stays = {name: ledger.stays() for name, ledger in self._ledgers.items()}
            solved = calibrate(stays, self._doubtful(), self._writer.site.known_ground)
            self.solved = solved, now_ns
        finally:
            took_s = time.thread_time() - began_s
            self._due_s = time.monotonic() + REST * took_s
        values = (len(stays), took_s, solved.common.observed, solved.common.reason)
        log.info("calibration solved machines=%d seconds=%.2f common_scale=%s reason=%s", *values)
        return solved

    def _follow(self, most: int) -> bool:
        """Take about so many samples into the ledgers; whether all are in that there were."""
        if self._from_ns is None:
            self._from_ns = max(0, self._now_ns() - DAYS * DAY_NS)
        until, taken = self._reader.last_row, 0
        for rows in self._past.rows(self._reader, Selection(from_ns=self._from_ns), self._followed, until):
            self._add(rows)
            self._followed = int(rows.numbers[-1])
            taken += len(rows.samples)
            if taken >= most or self._ending.is_set():
                return False
        self._followed, self._from_ns = until, 0  # what is late from now on is of interest
        return True

    def _add(self, rows: JournalRows) -> None:
        machine = np.repeat(rows.machine, rows.lengths)
        machine[~is_foldable(rows.samples, self._past.config)] = -1
        for index, name in enumerate(rows.machines):
            own = rows.samples.view(RAW_SAMPLE)[machine == index].view(SAMPLE_DTYPE)
            self._ledgers.setdefault(name, Ledger()).add(own)
