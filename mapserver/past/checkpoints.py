"""The checkpoints of one store: which there are, which of them can be used, and which is the nearest before a time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mapserver.past.checkpoint_file import Checkpoint, DamagedError, FileState, Header, file_state

FOLDER = "checkpoints"  # in the folder of a store
FactsBefore = Callable[[int], Mapping[str, Any]]  # what evidence of samples stamped before a time depends on
_FORMAT = "%Y-%m-%dT%H.checkpoint"
log = logging.getLogger("mapserver.past.checkpoints")


@dataclass(frozen=True)
class Entry:
    """A checkpoint by its name. header: None where the file is damaged. usable: whether it is true for given facts."""

    path: Path
    closed_ns: int
    bytes: int
    header: Header | None
    usable: bool = False


class Checkpoints:
    """The files in a folder; for any thread. One thread alone makes and removes them.

    passed_over: how many damaged ones were seen. state: what there was at the last look: how many usable ones, bytes of
    all, when the newest usable one is closed, 0 for none, and `passed_over`.
    """

    def __init__(self, store: Path) -> None:
        """store: the folder of a store."""
        self.folder = store / FOLDER
        self.passed_over = 0
        self.state = {"count": 0, "bytes": 0, "newest_ns": 0, "passed_over": 0}
        self._lock = threading.Lock()
        self._seen: dict[Path, tuple[FileState, Entry]] = {}

    def path(self, closed_ns: int) -> Path:
        """Where the one that is closed at a full hour lies."""
        return self.folder / datetime.fromtimestamp(closed_ns // 10**9, UTC).strftime(_FORMAT)

    def entries(self, facts: FactsBefore, last_row: int) -> list[Entry]:
        """All that there are, oldest first; usable are those made with these facts, of rows that there are."""
        with self._lock:
            paths = list(self.folder.glob("*.checkpoint"))
            known = [entry for path in paths if (entry := self._look(path))]
            self._seen = {path: self._seen[path] for path in paths if path in self._seen}
        entries = []
        for entry in sorted(known, key=lambda entry: entry.closed_ns):
            head = entry.header
            usable = head is not None and head.row <= last_row and head.facts == facts(entry.closed_ns)
            entries.append(replace(entry, usable=usable))
        return entries

    def nearest(self, until_ns: int, facts: FactsBefore, last_row: int) -> Checkpoint | None:
        """Open the newest usable one that is closed at `until_ns` or before; None where there is none."""
        for entry in reversed(self.entries(facts, last_row)):
            if entry.usable and entry.closed_ns <= until_ns:
                try:
                    checkpoint = Checkpoint(entry.path)
                except (OSError, DamagedError):  # removed or replaced a moment ago
                    continue
                if checkpoint.header == entry.header:
                    return checkpoint
                checkpoint.close()
        return None

    def look(self, facts: FactsBefore, last_row: int) -> list[Entry]:
        """As `entries`; `state` tells of them from then on."""
        entries = self.entries(facts, last_row)
        usable = [entry.closed_ns for entry in entries if entry.usable]
        counts = {"count": len(usable), "bytes": sum(entry.bytes for entry in entries), "newest_ns": max([0, *usable])}
        self.state = {**counts, "passed_over": self.passed_over}
        return entries

    def pass_over(self, checkpoint: Checkpoint, error: Exception) -> None:
        """Use one no more in which damage was found, until it is made again."""
        with self._lock:
            seen = self._seen.get(checkpoint.path)
            if seen and seen[0] == checkpoint.state:
                self._seen[checkpoint.path] = seen[0], replace(seen[1], header=None)
                self._count(checkpoint.path, error)

    def _look(self, path: Path) -> Entry | None:
        """What is known of a file, read anew where it changed; None where it is gone or has another name."""
        try:
            state = file_state(path.stat())
            closed_ns = round(datetime.strptime(path.name, _FORMAT).replace(tzinfo=UTC).timestamp()) * 10**9
        except (OSError, ValueError):
            return None
        if path not in self._seen or self._seen[path][0] != state:
            self._seen[path] = state, Entry(path, closed_ns, state[2], self._header(path, closed_ns))
        return self._seen[path][1]

    def _header(self, path: Path, closed_ns: int) -> Header | None:
        try:
            with Checkpoint(path) as checkpoint:
                if checkpoint.header.closed_ns == closed_ns:
                    return checkpoint.header
                raise DamagedError(path, f"is closed at another time, {checkpoint.header.closed_ns} ns")
        except (OSError, DamagedError) as error:
            self._count(path, error)
            return None

    def _count(self, path: Path, error: Exception) -> None:
        self.passed_over += 1
        log.warning("checkpoint passed over path=%s error=%r", path, str(error))


def remove_beyond(store: Path, last_row: int) -> None:
    """Remove those made of rows that the journal does not reach: once it grew past them they would pass for true.

    They are left where the journal was restored from a backup.
    """
    for entry in Checkpoints(store).entries(lambda _: {}, last_row):
        if entry.header and entry.header.row > last_row:
            log.warning("checkpoint removed path=%s row=%d last_row=%d", entry.path, entry.header.row, last_row)
            entry.path.unlink(missing_ok=True)
