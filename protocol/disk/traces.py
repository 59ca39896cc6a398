"""What lies beside a SQLite database: its write-ahead log, and a mark of what was committed to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from protocol.disk.high_water_mark import mark_path, read_mark
from protocol.disk.write_ahead_log import FRAME_HEADER, HEADER, LogScan, scan
from protocol.errors import StoreError
from protocol.files import PRIVATE, write_whole


@dataclass(frozen=True)
class Traces:
    """What lies beside a database that nobody has open. mark: see `HighWaterMark`; log: its write-ahead log.

    cut_short: the bytes of a log that SQLite does not take to its end, and soon writes over; else empty.
    """

    mark: dict[str, int]
    log: LogScan
    log_path: Path
    cut_short: bytes

    @property
    def damage(self) -> str:
        """What is wrong with the log, empty where nothing is."""
        if self.log.damaged_at is None:
            return ""
        dropped = self.log.frames - self.log.recovered
        return f"{self.log_path.name} is damaged at byte {self.log.damaged_at}: its last {dropped} pages cannot be used"

    def keep_log(self, number: int) -> None:
        """Keep a copy of a log that was cut short, for a person; raises OSError."""
        if self.cut_short:
            write_whole(self.log_path.with_name(f"{self.log_path.name}.damaged-{number}"), self.cut_short, PRIVATE)


def look_beside(database: Path) -> Traces:
    """Look before SQLite opens a database, and drops what it cannot use; StoreError where that cannot be read."""
    log_path = database.with_name(f"{database.name}-wal")
    try:
        log = log_path.read_bytes() if log_path.exists() else b""
        mark = read_mark(mark_path(database))
    except OSError as error:
        raise StoreError(database, f"cannot be read: {error}") from None
    held = scan(log)
    has_frames = len(log) > HEADER + FRAME_HEADER
    is_cut_short = has_frames and (held.recovered < held.frames or not held.recovered)
    return Traces(mark, held, log_path, log if is_cut_short else b"")
