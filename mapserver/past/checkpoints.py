"""The checkpoints of one store: which exist, which are usable, and the nearest before a time.

A snapshot is a checkpoint closed now, with all samples up to its row, so a restart folds only later rows. All are
caches: damaged ones, or those of another schema or facts, are ignored, and the journal is folded again.
"""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mapserver.evidence.grid_state import GridState
from mapserver.past.checkpoint_file import (
    OPEN_END_NS,
    Checkpoint,
    DamagedError,
    FileState,
    Header,
    file_state,
    write_checkpoint,
)

FOLDER = "checkpoints"  # subfolder of a store
FactsBefore = Callable[[int], Mapping[str, Any]]  # dependencies of evidence stamped before a time
_FORMAT = "%Y-%m-%dT%H.checkpoint"
_SNAPSHOT = re.compile(r"snapshot-(\d+)\.checkpoint")  # file name in a store's folder
KEPT_SNAPSHOTS = 2
log = logging.getLogger("mapserver.past.checkpoints")


@dataclass(frozen=True)
class Entry:
    """A checkpoint by name. header: None if damaged. usable: valid for given facts.

    closed_ns: OPEN_END_NS for a snapshot.
    """

    path: Path
    closed_ns: int
    bytes: int
    header: Header | None
    usable: bool = False


class Checkpoints:
    """A store's checkpoints; thread-safe. One thread writes hourly ones, one snapshots.

    passed_over: damaged ones seen. state: at the last look: usable ones, total bytes, closing time of the newest (0 for
    none), `passed_over`.
    """

    def __init__(self, store: Path) -> None:
        """store: its folder."""
        self.store, self.folder = store, store / FOLDER
        self.passed_over = 0
        self.state = {"count": 0, "bytes": 0, "newest_ns": 0, "passed_over": 0}
        self._lock = threading.Lock()
        self._seen: dict[Path, tuple[FileState, Entry]] = {}

    def path(self, closed_ns: int) -> Path:
        """Path of an hour's checkpoint."""
        return self.folder / datetime.fromtimestamp(closed_ns // 10**9, UTC).strftime(_FORMAT)

    def entries(self, facts: FactsBefore, last_row: int) -> list[Entry]:
        """Hourly checkpoints, oldest first; usable with these facts and rows."""
        return [entry for entry in self.with_snapshots(facts, last_row) if entry.closed_ns != OPEN_END_NS]

    def with_snapshots(self, facts: FactsBefore, last_row: int) -> list[Entry]:
        """As `entries`, then snapshots."""
        with self._lock:
            paths = [*self.folder.glob("*.checkpoint"), *self.store.glob("*.checkpoint")]
            known = [entry for path in paths if (entry := self._look(path))]
            self._seen = {path: self._seen[path] for path in paths if path in self._seen}
        entries = []
        for entry in sorted(known, key=lambda entry: (entry.closed_ns, entry.header.row if entry.header else 0)):
            head = entry.header
            usable = head is not None and head.row <= last_row and head.facts == facts(entry.closed_ns)
            entries.append(replace(entry, usable=usable))
        return entries

    def nearest(self, until_ns: int, facts: FactsBefore, last_row: int, from_ns: int = 0) -> Checkpoint | None:
        """Open the newest usable one closed in from_ns ... until_ns; None for none."""
        for entry in reversed(self.with_snapshots(facts, last_row)):
            if entry.usable and from_ns <= entry.closed_ns <= until_ns:
                try:
                    checkpoint = Checkpoint(entry.path)
                except (OSError, DamagedError):  # just removed or replaced
                    continue
                if checkpoint.header == entry.header:
                    return checkpoint
                checkpoint.close()
        return None

    def look(self, facts: FactsBefore, last_row: int) -> list[Entry]:
        """As `entries`, and update `state`."""
        entries = self.entries(facts, last_row)
        usable = [entry.closed_ns for entry in entries if entry.usable]
        counts = {"count": len(usable), "bytes": sum(entry.bytes for entry in entries), "newest_ns": max([0, *usable])}
        self.state = {**counts, "passed_over": self.passed_over}
        return entries

    def pass_over(self, checkpoint: Checkpoint, error: Exception) -> None:
        """Ignore a damaged one until it is replaced."""
        with self._lock:
            seen = self._seen.get(checkpoint.path)
            if seen and seen[0] == checkpoint.state:
                self._seen[checkpoint.path] = seen[0], replace(seen[1], header=None)
                self._count(checkpoint.path, error)

    def _look(self, path: Path) -> Entry | None:
        """A file's entry, read if changed; None if gone or no checkpoint."""
        try:
            state = file_state(path.stat())
            closed_ns = OPEN_END_NS if _SNAPSHOT.fullmatch(path.name) else _hour_of(path.name)
        except (OSError, ValueError):
            return None
        if path not in self._seen or self._seen[path][0] != state:
            self._seen[path] = state, Entry(path, closed_ns, state[2], self._header(path, closed_ns))
        return self._seen[path][1]

    def _header(self, path: Path, closed_ns: int) -> Header | None:
        try:
            with Checkpoint(path) as checkpoint:
                header = checkpoint.header
                if header.closed_ns == closed_ns and _row_of(path) in (None, header.row):
                    return header
                raise DamagedError(path, f"is another one, of row {header.row}, closed at {header.closed_ns} ns")
        except (OSError, DamagedError) as error:
            self._count(path, error)
            return None

    def _count(self, path: Path, error: Exception) -> None:
        self.passed_over += 1
        log.warning("checkpoint passed over path=%s error=%r", path, str(error))


def snapshot_rows(store: Path) -> list[int]:
    """Journal rows of a store's snapshots, newest first."""
    rows = map(_row_of, store.glob("snapshot-*.checkpoint"))
    return sorted((row for row in rows if row is not None), reverse=True)


def snapshot_path(store: Path, row: int) -> Path:
    """Path of a row's snapshot."""
    return store / f"snapshot-{row}.checkpoint"


def save_snapshot(store: Path, row: int, facts: Mapping[str, Any], state: GridState) -> Path:
    """Write a snapshot and remove all but the newest two. Raises OSError.

    facts: dependencies of its evidence, closed at OPEN_END_NS.
    """
    path = snapshot_path(store, row)
    for part in store.glob(".snapshot-*.part"):  # of killed processes: only this one writes here
        part.unlink(missing_ok=True)
    write_checkpoint(path, Header(OPEN_END_NS, row, facts), state)
    for old in snapshot_rows(store)[KEPT_SNAPSHOTS:]:
        snapshot_path(store, old).unlink(missing_ok=True)
    return path


def remove_beyond(store: Path, last_row: int) -> None:
    """Remove checkpoints beyond the journal, which would seem valid once it grows past them.

    They remain when a journal is restored or loses its end. A snapshot's name has its row even if it is damaged.
    """
    for entry in Checkpoints(store).with_snapshots(lambda _: {}, last_row):
        row = entry.header.row if entry.header else _row_of(entry.path) or 0
        if row > last_row:
            log.warning("checkpoint removed path=%s row=%d last_row=%d", entry.path, row, last_row)
            entry.path.unlink(missing_ok=True)


def _row_of(path: Path) -> int | None:
    """Row in a snapshot's name, else None."""
    match = _SNAPSHOT.fullmatch(path.name)
    return int(match.group(1)) if match else None


def _hour_of(name: str) -> int:
    """Closing time in a name; ValueError for another name."""
    return round(datetime.strptime(name, _FORMAT).replace(tzinfo=UTC).timestamp()) * 10**9
