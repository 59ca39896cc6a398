"""Search for changes of the ground: look at what was folded since the last look; keep and publish each change."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from mapserver.change import change_log
from mapserver.change.change_log import ChangeLog, GroundChange
from mapserver.change.detection import reach_blocks
from mapserver.change.validity import around
from mapserver.config import ServerConfig
from mapserver.evidence.timeline import Block, TimedPage
from mapserver.ingest.store import Store
from mapserver.ingest.writer import Writer
from mapserver.journal.reader import JournalReader

LOOK_BLOCKS = 256  # at a time: the writer copies their pages, and batches wait meanwhile
Publish = Callable[[dict[str, Any]], None]


class ChangeSearch:
    """Changes of one site. publish: is given each change, as plain values, when it is new or grows."""

    name = "changes"

    def __init__(
        self,
        writer: Writer,
        reader: JournalReader,
        cell_m: float,
        config: ServerConfig,
        publish: Publish,
        ending: threading.Event,
    ) -> None:
        self._writer, self._publish, self._ending = writer, publish, ending
        self._reach = reach_blocks(cell_m, config.change)
        kept = [event.body for event in reader.events(change_log.KIND)]
        self._log = ChangeLog(cell_m, config.change, config.read, kept)
        self._lock = threading.Lock()
        writer.run(lambda store: store.grid.touch_all())  # the log knows the changes, but not yet their cells

    def changes(self, after: int) -> list[dict[str, Any]]:
        """Changes with a number beyond `after`, as plain values; for any thread."""
        with self._lock:
            return [change.values for change in self._log.changes(after)]

    def run(self) -> None:
        """Look at all blocks that were folded into."""
        while not self._ending.is_set():
            blocks, pages = self._writer.run(lambda store: _touched(store, self._reach))
            if not blocks:
                return
            with self._lock:
                changes = self._log.look(blocks, pages)
            for change in changes:
                self._keep(change)
                self._publish(change.values)

    def _keep(self, change: GroundChange) -> None:
        self._writer.run(lambda store: store.journal.append_event(change_log.KIND, change.last_ns, change.values))


def _touched(store: Store, reach: int) -> tuple[list[Block], dict[Block, Sequence[TimedPage]]]:
    """Some of the blocks in which something was folded since they were looked at, and pages of them and around."""
    blocks = store.grid.take_touched(LOOK_BLOCKS)
    wide = sorted({near for block in blocks for near in around(block, reach)})
    return blocks, {block: pages for block, pages in zip(wide, store.grid.pages(wide), strict=True) if pages}
