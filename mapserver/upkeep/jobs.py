"""Periodic jobs of the upkeep: audit of machines, search for changes, archiving."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from mapserver.calibration.correction import UNCORRECTED, SampleCorrections
from mapserver.calibration.select import MachineErrors
from mapserver.change import change_log
from mapserver.change.change_log import ChangeLog
from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around, has_change
from mapserver.evidence.timeline import Block, TimedPages
from mapserver.ingest.decisions import ground_decisions
from mapserver.ingest.writer import Writer
from mapserver.journal import archived_decisions
from mapserver.journal.archive import archive
from mapserver.journal.journal import JournalReader
from mapserver.trust.auditor import Auditor, Verdict
from protocol.queries.answers import GroundChange

PIECE_S = 0.3  # seconds per turn, while others wait; ten machines' hourly checkpoint takes one in all
LOOK_BLOCKS = 256  # blocks per look for changes; batches wait while the writer copies their pages
# A block is examined after so many turns without traffic, or at most so many: each pass changes it again, and each look
# compares all of its evidence.
REST_TURNS, MOST_TURNS = 3, 20
LOOK_S = 60.0  # interval of looks for rows to archive, as files are hourly
KEEP_S = 3600.0  # interval of looks for decisions, without new files
Report = Callable[[Mapping[str, Verdict], int], None]
Known = Callable[[], tuple[SampleCorrections, Mapping[str, MachineErrors]]]
Publish = Callable[[GroundChange], None]
log = logging.getLogger("mapserver.upkeep.jobs")


class Job(Protocol):
    """Periodic work. name: for the log."""

    name: str

    def run(self) -> None:
        """Do what is due, and return soon."""


class Audit:
    """Feeds journalled, corrected samples to an auditor, and judges machines periodically.

    report: takes verdicts and site time [ns]. known: decided corrections, also of excluded machines, and calibration by
    machine.
    """

    name = "audit"

    def __init__(
        self, writer: Writer, reader: JournalReader, report: Report, known: Known, ending: threading.Event
    ) -> None:
        self.verdicts: Mapping[str, Verdict] = {}
        self._writer, self._reader, self._report, self._known, self._ending = writer, reader, report, known, ending
        self._corrections = UNCORRECTED
        self._judging: Iterator[dict[str, Verdict] | None] | None = None
        self._begin()
        self._due_s = 0.0

    def _begin(self) -> None:
        """Restart with the first unarchived row."""
        self._auditor = Auditor(self._writer.site.cell_m, self._writer.config.fold)
        self._followed = self._reader.archived_row

    def run(self) -> None:
        """Follow the journal; judge if due."""
        try:
            self._follow()
        finally:  # an unreadable row must not stop judging
            if time.monotonic() >= self._due_s:
                self._due_s = time.monotonic() + self._writer.config.trust.judge_s
                self._judging = self._judging or self._auditor.judging(self._known()[1])
            self._judge()

    def _judge(self) -> None:
        """Judge for a limited time: pairs of a large fleet take minutes."""
        until_s, judging, self._judging = time.thread_time() + PIECE_S, self._judging, None
        for verdicts in judging or ():
            if verdicts is not None:
                self.verdicts = verdicts
                self._report(verdicts, self._writer.run(lambda store: store.newest_ns))
            elif time.thread_time() >= until_s or self._ending.is_set():
                self._judging = judging
                return

    def _follow(self) -> None:
        corrections, _ = self._known()
        if corrections != self._corrections:  # a machine's map needs the same corrections throughout
            self._corrections = corrections
            self._begin()
        until = self._reader.last_row  # later rows wait for the next turn, or a busy site has no end
        for rows in self._reader.read_many(after=max(self._followed, self._reader.archived_row), until=until):
            samples = corrections.applied(rows.samples, rows.machines, np.repeat(rows.machine, rows.lengths))
            self._auditor.add_all(replace(rows, samples=samples))
            self._followed = int(rows.numbers[-1])
            if self._ending.is_set():
                return


class ChangeSearch:
    """Examines what was folded since. publish: takes new and extended changes."""

    name = "changes"

    def __init__(self, writer: Writer, reader: JournalReader, publish: Publish, ending: threading.Event) -> None:
        self._writer, self._publish, self._ending = writer, publish, ending
        cell_m, config = writer.site.cell_m, writer.config
        self._reach = reach_blocks(cell_m, config.change)
        kept = [event.body for event in reader.events(change_log.KIND)]
        self._log = ChangeLog(cell_m, config.change, config.read, kept)
        self._lock = threading.Lock()
        self._turn, self._touched = 0, dict[Block, tuple[int, int]]()  # first and last turn since the last look
        writer.run(lambda store: store.grid.touch_all())  # the log knows changes, but not their cells

    def changes(self, after: int) -> list[GroundChange]:
        """Changes numbered above `after`; thread-safe."""
        with self._lock:
            return self._log.changes(after)

    def run(self) -> None:
        """Examine due blocks; store and publish changes."""
        self._turn += 1
        for block in self._writer.run(lambda store: store.grid.take_touched(sys.maxsize)):
            self._touched[block] = self._touched.get(block, (self._turn, 0))[0], self._turn
        rested, most = self._turn - REST_TURNS, self._turn - MOST_TURNS
        due = sorted(block for block, (first, last) in self._touched.items() if last <= rested or first <= most)
        for begin in range(0, len(due), LOOK_BLOCKS):
            if self._ending.is_set():
                return
            for change in self._look(due[begin : begin + LOOK_BLOCKS]):
                self._keep(change)
                self._publish(change)

    def _look(self, blocks: list[Block]) -> list[GroundChange]:
        for block in blocks:
            del self._touched[block]
        pages, config = self._pages(blocks), self._writer.config.change
        blocks = [block for block in blocks if block in pages and has_change(pages[block], config)]
        if not blocks:
            return []
        pages = self._pages(sorted({near for block in blocks for near in around(block, self._reach)}))
        with self._lock:
            return self._log.look(blocks, pages)

    def _keep(self, change: GroundChange) -> None:
        self._writer.run(lambda store: store.journal.append_event(change_log.KIND, change.last_ns, asdict(change)))

    def _pages(self, blocks: list[Block]) -> dict[Block, TimedPages]:
        """Pages of blocks that have any."""
        pages = self._writer.run(lambda store: store.grid.pages(blocks))
        return {block: some for block, some in zip(blocks, pages, strict=True) if some}


class Archiving:
    """Moves old journal rows into hourly Parquet files, and stores decisions beside them.

    Shared journals are not archived, because files in one server's folder would be lost with its host.
    """

    name = "archiving"

    def __init__(self, writer: Writer, reader: JournalReader, ending: threading.Event) -> None:
        self._writer, self._reader, self._ending = writer, reader, ending
        self._due_s = 0.0
        self._kept, self._keep_s = 0, 0.0  # last decision stored beside the files; next time to look

    def run(self) -> None:
        """Move the next due hour; one per turn, for a quick shutdown."""
        after_h = self._writer.config.store.archive_after_h
        if not after_h or self._writer.location.is_shared or time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + LOOK_S
        now_ns, folder = self._writer.now_ns(), self._writer.location.archive.folder
        before_ns = now_ns - round(after_h * 3600e9)
        hours = archive(folder, self._reader, self._writer.site, before_ns, self._forget, now_ns)
        if path := next(hours, None):
            self._writer.run(lambda store: store.journal.shrink())
            log.info("archived file=%s", path.name)
            self._due_s = 0.0  # maybe more hours
        if path or time.monotonic() >= self._keep_s:
            self._keep_decisions(folder)

    def _keep_decisions(self, folder: Path) -> None:
        """Store calibration decisions beside files, if there are any.

        All are rewritten; those of archived hours rarely change.
        """
        self._keep_s = time.monotonic() + KEEP_S
        newest = self._writer.run(lambda store: store.fact)
        if folder.exists() and newest != self._kept:
            archived_decisions.save(folder, self._writer.store_id, ground_decisions(self._reader))
            self._kept = newest

    def _forget(self, until: int) -> int:
        if self._ending.is_set():  # rows in both count once, and the next start continues
            return until
        return self._writer.run(lambda store: store.journal.forget(until))
