"""Audit of machines: hand what is journalled to the auditor, and judge all machines from time to time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from mapserver.ingest.writer import Writer
from mapserver.journal.reader import JournalReader
from mapserver.trust.auditor import Auditor, Verdict

Report = Callable[[Mapping[str, Verdict], int], None]


class Audit:
    """Follows the journal on a connection of its own.

    report: is given all verdicts, and the site's now [ns]. interrupted: whether other work waits for the thread.
    """

    name = "audit"

    def __init__(
        self,
        writer: Writer,
        reader: JournalReader,
        auditor: Auditor,
        judge_s: float,
        report: Report,
        interrupted: Callable[[], bool],
    ) -> None:
        self.verdicts: Mapping[str, Verdict] = {}
        self._writer, self._reader, self._auditor = writer, reader, auditor
        self._judge_s, self._report, self._interrupted = judge_s, report, interrupted
        self._followed = reader.archived_row
        self._due_s = 0.0

    def run(self) -> None:
        """Follow the journal, then judge where it is time."""
        try:
            self._follow()
        finally:  # a row that cannot be read must not keep the machines from being judged by the others
            if time.monotonic() >= self._due_s:
                self._due_s = time.monotonic() + self._judge_s
                self.verdicts = self._auditor.verdicts()
                self._report(self.verdicts, self._writer.run(lambda store: store.newest_ns))

    def _follow(self) -> None:
        until = self._reader.last_row  # what comes in meanwhile waits for the next turn: a busy site has no end
        for row in self._reader.read(after=max(self._followed, self._reader.archived_row), until=until):
            self._auditor.add(row.machine, row.rows)
            self._followed = row.row
            if self._interrupted():
                return
