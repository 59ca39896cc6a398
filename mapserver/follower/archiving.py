"""Archiving: journal rows that are old enough move to hourly Parquet files."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from mapserver.ingest.writer import Writer
from mapserver.journal.archive import FOLDER, archive
from mapserver.journal.reader import JournalReader
from protocol.site.site_config import SiteConfig

LOOK_S = 60.0  # between two looks for rows that are old enough: files are of whole hours
log = logging.getLogger("mapserver.follower.archiving")


class Archiving:
    """Moves the rows of one store. after_h: how old rows are then, 0 for never."""

    name = "archiving"

    def __init__(
        self,
        writer: Writer,
        reader: JournalReader,
        site: SiteConfig,
        after_h: float,
        now_ns: Callable[[], int],
        ending: threading.Event,
    ) -> None:
        self._writer, self._reader, self._site = writer, reader, site
        self._after_h, self._now_ns, self._ending = after_h, now_ns, ending
        self._due_s = 0.0

    def run(self) -> None:
        """Move the next hour of old rows, where it is time: an hour a turn, so that the end need not wait."""
        if not self._after_h or time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + LOOK_S
        before_ns = self._now_ns() - round(self._after_h * 3600e9)
        hours = archive(self._reader.path.parent / FOLDER, self._reader, self._site, before_ns, self._forget)
        if path := next(hours, None):
            self._writer.run(lambda store: store.journal.shrink())
            log.info("archived file=%s", path.name)
            self._due_s = 0.0  # there may be more hours

    def _forget(self, until: int) -> int:
        if self._ending.is_set():  # what is in both meanwhile counts once, and the next start goes on with it
            return until
        return self._writer.run(lambda store: store.journal.forget(until))
