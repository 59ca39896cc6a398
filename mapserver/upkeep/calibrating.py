"""The job that calibrates machines: follows samples, solves at intervals of site time, and hands on results.

It keeps the machines' ledgers, rebuilt on start from the last days of journal and archive. The site's now comes from
recent samples (`SiteClock`): a wrong clock counts only while it is wrong.
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

SPAN_NS = 2 * DAY_NS  # age of samples read, which hold the driving that a ledger keeps
AHEAD_NS = 600 * 10**9  # tolerance beyond the site's now, for clocks and delays
EVERY_NS = 60 * 10**9  # site time between solves, a fifth of an epoch
REST = 50.0  # pause relative to a run: 2 % of a core, even for replays and large fleets
TURN_SAMPLES = 200_000  # samples read per turn, in about 0.2 s
Decide = Callable[[Solution, int], object]
Group = tuple[str, ...]
log = logging.getLogger("mapserver.upkeep.calibrating")
RECENT = 10  # marks after which a silent machine says nothing of now


class Calibrating:
    """Ledgers of all machines, and their calibration.

    solved: last solve, and its site time [ns]. decide: takes solves with site time [ns]. doubtful: machines without
    influence. shown: last corrections with a scale from evidence.
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
        # earliest possible sample by machine; of machines seen before, not all are read
        self._begins_ns = dict.fromkeys((machine for machine, _ in self._reader.watermarks()), 0)
        self._followed = 0
        self._passed_over = 0  # unreadable rows to skip next
        self._parts: dict[Group, Solution] = {}  # last solve of each group
        self._next = -1  # index of the last group
        self._from_ns: int | None = None  # of samples read; until caught up, only the last days
        self._due_s = 0.0
        self._turn = threading.Lock()  # guards all here: `solve` is thread-safe

    def states(self) -> Mapping[str, MachineErrors]:
        """The last solve's machines, by name."""
        return self.solved[0].machines

    def run(self) -> None:
        """Follow the journal; when up to date and due, solve the next group and hand it on."""
        if time.monotonic() < self._due_s or not self._turn.acquire(blocking=False):  # busy during a `solve`
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
        """Solve with all that is journalled now; returns result and site time [ns]. Thread-safe."""
        with self._turn:
            while not self._follow(TURN_SAMPLES) and not self._ending.is_set():
                pass
            now_ns, together = self._begun()
            for some in together:
                if not self._ending.is_set():
                    self._solve(some, together, now_ns)
            return self.solved

    def close(self) -> None:
        """Close the journal, unless a solve is running, which ends with the process."""
        if self._turn.acquire(blocking=False):
            self._reader.close()  # keeps the turn, so that nothing runs any more

    def _begun(self) -> tuple[int, list[Group]]:
        """Site time, and all groups of machines, as after a start."""
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
        """Solve one group. together: all groups."""
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
        """Add about `most` samples to the ledgers; returns whether all are in.

        Unreadable rows are skipped, in growing steps: missing evidence makes corrections less certain, not wrong.
        """
        if self._from_ns is None:
            self._from_ns = max(0, self._writer.run(lambda store: store.newest_ns) - SPAN_NS)
        until, taken = self._reader.last_row, 0
        self._followed = min(self._followed + self._passed_over, until)
        try:
            for rows in self._past.rows(self._reader, Selection(from_ns=self._from_ns), self._followed, until):
                self._passed_over = 0
                self._followed = int(rows.numbers[-1])  # first, so that failures are not repeated
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
        self._followed, self._from_ns, self._passed_over = until, 0, 0  # late samples matter from here on
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
        if self._from_ns:  # earlier data is already decided
            self._clock.mark()

    def _share_room(self) -> None:
        """Set the number of epochs that each ledger keeps to what a solve takes."""
        epochs = epochs_of_each(len(self._ledgers))
        if any(ledger.epochs != epochs for ledger in self._ledgers.values()):
            log.info("calibration machines=%d epochs=%d: so many of each are remembered", len(self._ledgers), epochs)
        for ledger in self._ledgers.values():
            ledger.epochs = epochs


class SiteClock:
    """Site time for a periodic job, which marks each run.

    A machine's time is that of its last received sample, so it falls back with its clock.
    """

    def __init__(self) -> None:
        self._marks = 0
        self._last_ns: dict[str, int] = {}  # by machine: last received stamp
        self._since: dict[str, int] = {}  # by machine: the mark before it
        self._marked_ns: dict[str, int] = {}  # by machine: last stamp at the last mark, or its first

    def add(self, machine: str, oldest_ns: int, last_ns: int) -> None:
        """Note samples, by oldest and last received stamp."""
        self._marked_ns.setdefault(machine, oldest_ns)
        self._last_ns[machine], self._since[machine] = last_ns, self._marks

    def now_ns(self, without: Collection[str] = ()) -> int:
        """Newest stamp [ns] of recently active machines, except some; 0 for none."""
        since = {name: mark for name, mark in self._since.items() if name not in without} or self._since
        last = max(since.values(), default=0)
        return max((self._last_ns[name] for name, mark in since.items() if mark > last - RECENT), default=0)

    def passed_ns(self, without: Collection[str] = ()) -> int:
        """Site time since the last mark [ns]: the largest step of any machine, either way."""
        names = (name for name, mark in self._since.items() if mark == self._marks and name not in without)
        return max((abs(self._last_ns[name] - self._marked_ns[name]) for name in names), default=0)

    def mark(self) -> None:
        """Restart the count."""
        self._marked_ns |= self._last_ns
        self._marks += 1
