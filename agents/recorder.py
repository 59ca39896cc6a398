"""[record]: an agent records its readings; the oldest files make room for new ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from protocol.config import require_positive
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.machine.recorded_readings import record_reading
from protocol.recording import Recording

FILES = 20  # files that share max_mb: the share lost with the oldest one
AGAIN_S = 60.0  # pause after a disk error


@dataclass(frozen=True)
class RecordConfig:
    """Where readings are recorded. folder: empty for none. max_mb: of all the machine's files [MB]."""

    folder: str = ""
    max_mb: float = 2000.0

    def __post_init__(self) -> None:
        require_positive(self, ("max_mb",))


class ReadingsRecorder:
    """Records one machine's readings; a full disk stops recording, not the machine."""

    def __init__(
        self,
        config: RecordConfig,
        site: str,
        machine: MachineConfig,
        now_ns: Callable[[], int] = time.time_ns,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """ModuleNotFoundError without the extra `record`; OSError for an impossible folder."""
        import mcap.writer  # noqa: F401 - now, not at the first reading

        self._folder, self._file_bytes = Path(config.folder), config.max_mb * 1e6 / FILES
        self._machine, self._sensors = machine.name, {sensor.name for sensor in machine.sensors}
        self._about = {"site": site, "machine": machine.name}
        self._now_ns, self._clock, self._again_s = now_ns, clock, 0.0
        self._recording: Recording | None = None
        self._counts = {"readings": 0, "missed": 0}
        self._problem = ""
        self._folder.mkdir(parents=True, exist_ok=True)

    def take(self, readings: Sequence[Reading]) -> None:
        """Record readings of the machine's own sensors."""
        own = [reading for reading in readings if reading.sensor in self._sensors]
        if self._clock() < self._again_s:
            self._counts["missed"] += len(own)
            return
        log_ns = self._now_ns()
        try:
            for reading in own:
                self._recording = self._recording or self._open(log_ns)
                record_reading(self._recording, self._machine, log_ns, reading)
                self._counts["readings"] += 1
                self._problem = ""
        except OSError as error:
            self._fail(error)

    def tend(self) -> None:
        """Each second: flush, and close a full file."""
        if not self._recording:
            return
        try:
            self._recording.tend()
            if self._recording.size > self._file_bytes:
                self.close()
        except OSError as error:
            self._fail(error)

    def report(self) -> dict[str, Any]:
        """State in plain values."""
        return {**self._counts, "problem": self._problem}

    def close(self) -> None:
        """Complete the current file."""
        if self._recording:
            try:
                self._recording.finish()
            except OSError as error:
                self._fail(error)
            self._recording = None

    def _open(self, log_ns: int) -> Recording:
        kept_bytes = (FILES - 1) * self._file_bytes
        for path in sorted(self._folder.glob(f"{self._machine}.*.mcap*"), reverse=True):
            kept_bytes -= path.stat().st_size
            if kept_bytes < 0:
                path.unlink()
        begin = datetime.fromtimestamp(log_ns * 1e-9, UTC)
        return Recording(self._folder / f"{self._machine}.{begin:%Y%m%dT%H%M%S.%fZ}.mcap", self._about, self._clock)

    def _fail(self, error: OSError) -> None:
        self._problem = f"readings are not recorded: {error.filename}: {error.strerror}"
        self._again_s = self._clock() + AGAIN_S
        if self._recording:
            self._recording.abandon()
            self._recording = None
