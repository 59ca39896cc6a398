"""What lies beside a SQLite database: its write-ahead log, and a mark of what was committed to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from protocol.disk.high_water_mark import mark_path, read_mark
from protocol.disk.write_ahead_log import LogScan, scan
from protocol.errors import StoreError
from protocol.files import PRIVATE, write_whole


@dataclass(frozen=True)
class Traces:
    """What lies beside a database that nobody has open. mark: see `HighWaterMark`; log: its write-ahead log."""

    mark: dict[str, int]
    log: LogScan
    log_path: Path

    @property
    def damage(self) -> str:
        """What is wrong with the log, empty where nothing is."""
        if self.log.damaged_at is None:
            return ""
        dropped = self.log.frames - self.log.recovered
        return f"{self.log_path.name} is damaged at byte {self.log.damaged_at}: its last {dropped} pages cannot be used"


def look_beside(database: Path) -> Traces:
    """Look before SQLite opens a database, and drops what it cannot use; StoreError where that cannot be read."""
    log_path = database.with_name(f"{database.name}-wal")
    try:
        log = scan(log_path.read_bytes()) if log_path.exists() else LogScan()
        return Traces(read_mark(mark_path(database)), log, log_path)
    except OSError as error:
        raise StoreError(database, f"cannot be read: {error}") from None


def keep_log(traces: Traces, number: int) -> None:
    """Keep a copy of a log whose end SQLite is about to write over, for a person; raises OSError."""
    if traces.log.frames:
        kept = traces.log_path.with_name(f"{traces.log_path.name}.damaged-{number}")
        write_whole(kept, traces.log_path.read_bytes(), PRIVATE)
