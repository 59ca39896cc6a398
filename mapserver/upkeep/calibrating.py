"""The job that calibrates machines: follows the samples, solves now and then in site time, and has the result decided.

What it remembers are the ledgers of the machines. A server that starts makes them anew, from the journal and archive of
the last days. The site's now is that of what machines sent lately (`SiteClock`): a clock that is wrong counts while it
is wrong, and not a day longer.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from mapserver.calibration.calibrate import Solution, calibrate, epochs_of_each, groups, joined
from mapserver.calibration.correction import Correction
from mapserver.calibration.ledger import StayLedger
from mapserver.calibration.select import MachineErrors, remembered_of
from mapserver.evidence.fold_config import is_foldable
from mapserver.ingest.writer import Writer
from mapserver.journal.rows import JournalRows, Selection
from mapserver.past.past import StorePast
from protocol.errors import StoreError
from protocol.machine.samples import RAW_SAMPLE, SAMPLE_DTYPE
from protocol.units import DAY_NS

SPAN_NS = 2 * DAY_NS  # of samples, which hold the hours of driving that a ledger remembers of a machine at work
AHEAD_NS = 600 * 10**9  # of the site's now: machines' clocks, and what is on its way, differ by less
EVERY_NS = 60 * 10**9  # of site time, between two solves: a fifth of an epoch
REST = 50.0  # times as long as a run took: 2 % of a core, also where a log is replayed, or a fleet is large
TURN_SAMPLES = 200_000  # read in one turn, in about 0.2 s
Decide = Callable[[Solution, int], object]
Group = tuple[str, ...]
log = logging.getLogger("mapserver.upkeep.calibrating")
RECENT = 10  # marks; a machine that was silent for longer says nothing of now, though its clock may have been ahead


class Calibrating:
    """Ledgers of all machines, and what they come to. solved: the last solve, and the site's now then [ns].

    decide: is given each solve and the site's now [ns]. doubtful: machines that are to have no say now. shown: the last
    corrections whose scale evidence showed.
    """

    name = "calibration"

    def __init__(
        self,
        writer: Writer,
        past: StorePast,
        decide: Decide,
        doubtful: Callable[[], frozenset[str]],
        shown: Callable[[], Iterable[Correction]],
        ending: threading.Event,
    ) -> None:
        self.solved: tuple[Solution, int] = calibrate({}), 0
        self._writer, self._past, self._decide, self._doubtful, self._ending = writer, past, decide, doubtful, ending
        self._shown = shown
        self._reader = writer.location.reader()
        self._clock = SiteClock()
        self._ledgers: dict[str, StayLedger] = {}
        # By machine, from when on there may be samples of it: of one that was here before, not all are read.
        self._begins_ns = dict.fromkeys((machine for machine, _ in self._reader.watermarks()), 0)
        self._followed = 0
        self._passed_over = 0  # rows that could not be read, at the next attempt
        self._parts: dict[Group, Solution] = {}  # the last solve of each group
        self._next = -1  # of the groups
        self._from_ns: int | None = None  # of samples that are read: until it has caught up, those of the last days
        self._due_s = 0.0
        self._turn = threading.Lock()  # of all that is used here: `solve` is for any thread

    def states(self) -> Mapping[str, MachineErrors]:
        """What the last solve says of machines, by name."""
        return self.solved[0].machines

    def run(self) -> None:
        """Follow the journal; where that is done and it is time, solve the next group, and have it decided."""
        if time.monotonic() < self._due_s or not self._turn.acquire(blocking=False):  # as while somebody has it solved
            return
        began_s, rest = time.thread_time(), REST
        try:
            if not self._follow(TURN_SAMPLES):
                rest = 0.0
            elif self._clock.passed_ns(self._doubtful()) >= EVERY_NS:
                self._solve_next()
        finally:
            self._due_s = time.monotonic() + rest * (time.thread_time() - began_s)
            self._turn.release()

    def solve(self) -> tuple[Solution, int]:
        """Solve with all that is journalled by now; what came out, and the site's now [ns]. For any thread."""
        with self._turn:
            while not self._follow(TURN_SAMPLES) and not self._ending.is_set():
                pass
            now_ns, together = self._begun()
            for some in together:
                if not self._ending.is_set():
                    self._solve(some, together, now_ns)
            return self.solved

    def close(self) -> None:
        """Close the journal, unless a solve goes on: that ends with the process, and is of no use any more."""
        if self._turn.acquire(blocking=False):
            self._reader.close()  # and keep the turn: nothing runs any more

    def _begun(self) -> tuple[int, list[Group]]:
        """The site's now, and all groups of machines, without those that left: as after a start."""
        now_ns = self._clock.now_ns(self._doubtful())
        self._clock.mark()
        self._ledgers = {name: own for name, own in self._ledgers.items() if own.newest_ns >= now_ns - SPAN_NS}
        self._share_room()
        return now_ns, groups(self._ledgers)

    def _solve_next(self) -> None:
        now_ns, together = self._begun()
        self._next = (self._next + 1) % len(together)
        solved = self._solve(together[self._next], together, now_ns)
        if self._writer.config.calibration.automatic and not self._ending.is_set():
            self._decide(solved, now_ns)

    def _solve(self, names: Group, together: Sequence[Group], now_ns: int) -> Solution:
        """Solve one group of machines; what it says. together: all groups."""
        began_s, stays = time.thread_time(), {}
        for name in names:
            self._ledgers[name].until_ns = now_ns + AHEAD_NS
            stays[name] = self._ledgers[name].stays(now_ns - SPAN_NS)
        remembered = remembered_of(self._shown())
        solved = calibrate(stays, self._doubtful(), self._writer.site.known_ground, remembered)
        solved = replace(solved, begins_ns={name: self._begins_ns[name] for name in names})
        self._parts = {some: part for some, part in self._parts.items() if some in together} | {names: solved}
        self.solved = joined([*self._parts.values()]), now_ns
        took_s = time.thread_time() - began_s
        values = (len(names), len(self._ledgers), took_s, solved.common.observed, solved.common.reason)
        log.info("calibration solved machines=%d of=%d seconds=%.2f common_scale=%s reason=%s", *values)
        return solved

    def _follow(self, most: int) -> bool:
        """Take about so many samples into the ledgers; whether all are in that there were.

        Where rows cannot be read, it goes on behind them the next time, as far as it takes: evidence that is missing
        makes corrections less sure, not wrong.
        """
        if self._from_ns is None:
            self._from_ns = max(0, self._writer.run(lambda store: store.newest_ns) - SPAN_NS)
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
        parts = {
            name: rows.samples.view(RAW_SAMPLE)[machine == index].view(SAMPLE_DTYPE)
            for index, name in enumerate(rows.machines)
        }
        parts = {name: own for name, own in parts.items() if len(own)}
        for name, own in parts.items():
            first_ns = int(own["stamp_ns"].min())
            self._begins_ns[name] = min(first_ns, self._begins_ns.get(name, first_ns))
            self._clock.add(name, first_ns, int(own["stamp_ns"][-1]))
        until_ns = self._clock.now_ns(self._doubtful()) + AHEAD_NS
        for name, own in parts.items():
            if name not in self._ledgers:
                self._ledgers[name] = StayLedger()
                self._share_room()
            self._ledgers[name].until_ns = until_ns
            self._ledgers[name].add(own)
        if self._from_ns:  # what was known before the start is decided already
            self._clock.mark()

    def _share_room(self) -> None:
        """Have each ledger remember what a solve of so many machines takes, and no more."""
        epochs = epochs_of_each(len(self._ledgers))
        if any(ledger.epochs != epochs for ledger in self._ledgers.values()):
            log.info("calibration machines=%d epochs=%d: so many of each are remembered", len(self._ledgers), epochs)
        for ledger in self._ledgers.values():
            ledger.epochs = epochs


class SiteClock:
    """Site time for a job that looks now and then, which is marked each time.

    A machine is as far as what came in of it last, so that it falls back with the machine's clock.
    """

    def __init__(self) -> None:
        self._marks = 0
        self._last_ns: dict[str, int] = {}  # by machine, of what came in last
        self._since: dict[str, int] = {}  # by machine, behind which mark that came in
        self._marked_ns: dict[str, int] = {}  # by machine, its last at the last mark, or its first stamp of all

    def add(self, machine: str, oldest_ns: int, last_ns: int) -> None:
        """Take samples of a machine into account, by the oldest stamp and that of what came in last."""
        self._marked_ns.setdefault(machine, oldest_ns)
        self._last_ns[machine], self._since[machine] = last_ns, self._marks

    def now_ns(self, without: Collection[str] = ()) -> int:
        """The newest stamp of all machines but some [ns], of those that sent anything of late; 0 for none."""
        since = {name: mark for name, mark in self._since.items() if name not in without} or self._since
        last = max(since.values(), default=0)
        return max((self._last_ns[name] for name, mark in since.items() if mark > last - RECENT), default=0)

    def passed_ns(self, without: Collection[str] = ()) -> int:
        """Site time since the last mark [ns], by the machine that went on furthest, or was set back."""
        names = (name for name, mark in self._since.items() if mark == self._marks and name not in without)
        return max((abs(self._last_ns[name] - self._marked_ns[name]) for name in names), default=0)

    def mark(self) -> None:
        """Begin to count anew what has passed."""
        self._marked_ns |= self._last_ns
        self._marks += 1
