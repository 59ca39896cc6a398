"""The job that writes snapshots: often enough for quick restarts, rarely enough to be cheap."""

from __future__ import annotations

import time
from collections.abc import Callable

from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer

RESTART_SAMPLES = 500_000  # samples, about a second of a restart, that trigger an early snapshot
SHARE = 0.05  # largest share of the time


class Snapshots:
    """Writes due snapshots, taken by the writer."""

    name = "snapshots"

    def __init__(self, writer: Writer, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic [s]."""
        self._writer, self._clock, self._every_s = writer, clock, writer.config.store.snapshot_s
        self._began_s = self._earliest_s = clock()

    def run(self) -> None:
        """Write one if due. After an OSError it is not retried at once."""
        began_s = self._clock()
        samples = self._writer.run(lambda store: store.samples_behind)
        wait_s = 0.0 if samples >= RESTART_SAMPLES else self._every_s
        if began_s < max(self._began_s + wait_s, self._earliest_s):
            return
        self._began_s, self._earliest_s = began_s, began_s + self._every_s
        if write := self._writer.run(Store.snapshot):
            write()
        ended_s = self._clock()
        self._earliest_s = ended_s + (ended_s - began_s) * (1 / SHARE - 1)
