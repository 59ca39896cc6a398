"""The job that makes checkpoints, a piece per turn, and removes unneeded ones."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapserver.ingest.writer import Writer
from mapserver.journal.facts import Facts
from mapserver.journal.journal import JournalReader
from mapserver.past.checkpoints import Entry
from mapserver.past.making import make, remove_unfinished
from mapserver.past.past import StorePast
from mapserver.past.plan import due, surplus, thinned
from mapserver.upkeep.jobs import PIECE_S
from protocol.units import MINUTE_NS

LATE_ROWS = 5000  # late rows after which a checkpoint is rebuilt; reading them takes 50 ms
RESERVE_BYTES = 2**30  # free space kept for samples
LATER_S = 60.0  # pause after damage, or without room
log = logging.getLogger("mapserver.upkeep.checkpointing")


@dataclass(frozen=True)
class _Making:
    """An unfinished checkpoint. began_s: monotonic."""

    path: Path
    closed_ns: int
    depends_on: Mapping[str, Any]
    steps: Iterator[None]
    began_s: float


class Checkpointing:
    """Makes checkpoints, replaces unusable or outdated ones, and limits their size."""

    name = "checkpoints"

    def __init__(self, writer: Writer, reader: JournalReader, past: StorePast, ending: threading.Event) -> None:
        self._writer, self._reader, self._past, self._ending = writer, reader, past, ending
        self._limit_bytes = round(writer.config.store.checkpoints_gb * 1e9)
        self._making: _Making | None = None
        self._expected_bytes = 0  # of the next one, as of the last
        self._nothing_due: object = None  # state in which nothing was due
        self._looked = 0
        self._due_s = 0.0
        remove_unfinished(past.checkpoints)

    def run(self) -> None:
        """Continue the unfinished checkpoint, or start a due one."""
        if time.monotonic() < self._due_s:
            return
        try:
            self._turn()
        except Exception:  # logged by the upkeep; retried later
            self.close()
            self._due_s = time.monotonic() + LATER_S
            raise

    def close(self) -> None:
        """Cancel the unfinished checkpoint."""
        if self._making:
            self._making.steps.close()  # type: ignore[attr-defined]
            self._making = None

    def _turn(self) -> None:
        now_ns, facts = self._writer.run(lambda store: (store.newest_ns, store.facts))
        before = self._past.depends_on(self._reader, facts)
        if self._making and self._making.depends_on != before(self._making.closed_ns):
            self.close()
        if not self._making:
            entries = self._past.checkpoints.look(before, self._reader.last_row)
            self._remove(entries, surplus(now_ns, [entry.closed_ns for entry in entries]))
            closed_ns = self._next(now_ns, facts, entries)
            more = 0 if closed_ns is None else max([self._expected_bytes, *(entry.bytes for entry in entries[-1:])])
            if not self._has_room(now_ns, entries, more) or closed_ns is None:
                return
            steps, path = make(self._past, self._reader, closed_ns, facts), self._past.checkpoints.path(closed_ns)
            self._making = _Making(path, closed_ns, before(closed_ns), steps, time.monotonic())
        self._go_on(self._making)

    def _go_on(self, making: _Making) -> None:
        until_s = time.monotonic() + PIECE_S
        for _ in making.steps:
            if time.monotonic() >= until_s or self._ending.is_set():
                return
        self._making = None
        self._expected_bytes = making.path.stat().st_size
        values = (making.path.name, self._expected_bytes, time.monotonic() - making.began_s)
        log.info("checkpoint made name=%s bytes=%d seconds=%.1f", *values)

    def _next(self, now_ns: int, facts: Facts, entries: list[Entry]) -> int | None:
        """Closing time of the next one, or None."""
        usable, unusable = ([entry.closed_ns for entry in entries if entry.usable == each] for each in (True, False))
        there = (now_ns // MINUTE_NS, facts, *usable, None, *unusable)
        if there != self._nothing_due:
            closed_ns = due(now_ns, usable, unusable, lambda from_ns: self._past.next_stamp(self._reader, from_ns))
            if closed_ns is not None:
                return closed_ns
            self._nothing_due = there
        return self._overtaken([entry for entry in entries if entry.usable])

    def _overtaken(self, usable: list[Entry]) -> int | None:
        """A checkpoint that lacks many late rows; checks another one each turn."""
        self._looked += 1
        for entry in usable[self._looked % max(1, len(usable)) :][:1]:
            if entry.header and self._past.late_rows(self._reader, entry.header) >= LATE_ROWS:
                return entry.closed_ns
        return None

    def _has_room(self, now_ns: int, entries: list[Entry], more: int) -> bool:
        """Make room for more bytes, within limit and disk space; returns whether there is."""
        there = sum(entry.bytes for entry in entries)
        spare = shutil.disk_usage(self._writer.location.folder).free - RESERVE_BYTES
        most = min(self._limit_bytes, there + spare) - more
        if there > most:
            begin_ns = self._past.next_stamp(self._reader, 0) or 0
            sizes = {entry.closed_ns: entry.bytes for entry in entries}
            self._remove(entries, thinned(begin_ns, now_ns, sizes, most))
        if most > 0:
            return True
        self._due_s = time.monotonic() + LATER_S
        if self._limit_bytes:
            values = (more, self._limit_bytes, spare)
            log.warning("no room for checkpoints, maps of the past take longer bytes=%d limit=%d spare=%d", *values)
        return False

    def _remove(self, entries: list[Entry], closed: Iterable[int]) -> None:
        gone = set(closed)
        for entry in list(entries):
            if entry.closed_ns in gone:
                entry.path.unlink(missing_ok=True)
                entries.remove(entry)
