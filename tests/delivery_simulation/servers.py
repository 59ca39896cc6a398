"""Two map servers for the simulation: a fast model of the journal, and the real store."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from mapserver.config import ServerConfig
from mapserver.ingest.admission import GapError, admit, check_store, judge_batch
from mapserver.ingest.store import Incoming, Store
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import Admission, StoreIdentity
from mapserver.journal.sqlite.journal import SqliteJournal
from protocol.errors import MessageError, Refusal
from protocol.site.site_config import SiteConfig
from protocol.wire.codec import decode_batch
from protocol.wire.messages import Ack, Refused
from tests.delivery_simulation.faults import Fault, FaultPlan, FaultyConnection, Killed

RunKey = tuple[str, int]  # machine, spool_id
STORE = StoreIdentity("0123456789abcdef")


class JournalledSample(NamedTuple):
    machine: str
    spool_id: int
    seq: int
    row: bytes


@dataclass
class _Disk:
    """Committed data."""

    rows: list[Admission] = field(default_factory=list)
    marks: dict[RunKey, tuple[int, int]] = field(default_factory=dict)

    def copy(self) -> _Disk:
        return _Disk(list(self.rows), dict(self.marks))


class ModelServer:
    """Real rules of admission on a modelled journal."""

    def __init__(self, site: SiteConfig, now_ns: Callable[[], int]) -> None:
        self.disk = _Disk()
        self._site = site
        self._now_ns = now_ns
        self._backup = _Disk()

    def take(self, group: list[Incoming], plan: FaultPlan) -> list[Ack | Refused]:
        """Reply to a group of batches in one commit; Killed by plan, usable afterwards."""
        fault = plan.fault
        plan.disarm()
        new = self.disk.copy()
        answers = [self._take_one(new, incoming) for incoming in group]
        return self.commit(new, answers, fault)

    def commit(self, new: _Disk, answers: list[Ack | Refused], fault: Fault | None) -> list[Ack | Refused]:
        """Commit, then reply."""
        if fault == Fault.KILLED_BEFORE:
            raise Killed
        if fault in (Fault.FULL, Fault.FULL_ROLLED_BACK):
            return [Refused(Refusal.STORE, "the server cannot write: disk full") for _ in answers]
        self.disk = new
        if fault == Fault.KILLED_AFTER:
            raise Killed
        return answers

    def back_up(self) -> None:
        self._backup = self.disk.copy()

    def restore(self) -> None:
        self.disk = self._backup.copy()

    def samples(self) -> Iterator[JournalledSample]:
        for admission in self.disk.rows:
            batch = admission.batch
            for i, row in enumerate(batch.rows):
                yield JournalledSample(batch.machine, batch.spool_id, batch.first_seq + i, row.tobytes())

    def marks(self) -> dict[RunKey, tuple[int, int]]:
        """Watermark and declared losses by run."""
        return self.disk.marks

    def _take_one(self, disk: _Disk, incoming: Incoming) -> Ack | Refused:
        try:
            batch = decode_batch(incoming.payload, self._site.extent_m)
            judge_batch(batch, incoming.machine, self._site, self._now_ns)
            check_store(batch, STORE, ())
            seq, lost = disk.marks.get((batch.machine, batch.spool_id), (0, 0))
            admission = admit(batch, seq)
        except MessageError as error:
            expected = error.expected if isinstance(error, GapError) else 0
            return Refused(error.reason, str(error), expected)
        if len(admission.batch.rows):
            disk.rows.append(admission)
        if len(admission.batch.rows) or admission.lost:
            disk.marks[batch.machine, batch.spool_id] = (admission.watermark, lost + admission.lost)
        return Ack(admission.watermark, len(disk.rows), admission.trimmed, STORE.id)


class RealServer:
    """The real store in a folder, with the model's methods."""

    def __init__(self, folder: Path, site: SiteConfig, now_ns: Callable[[], int]) -> None:
        self._folder, self._backup = folder / "store", folder / "store-backup"
        self._site = site
        self._now_ns = now_ns
        self._plan = FaultPlan()
        self.open()
        self.back_up()

    def take(self, group: list[Incoming], plan: FaultPlan) -> list[Ack | Refused]:
        """Like Store.commit; restarted after a kill."""
        if plan.fault:
            self._plan.arm(plan.fault, plan.left)
        plan.disarm()
        try:
            return self._store.commit(group)
        except Killed:
            self.close()
            self.open()
            raise
        finally:
            self._plan.disarm()

    def back_up(self) -> None:
        shutil.rmtree(self._backup, ignore_errors=True)
        shutil.copytree(self._folder, self._backup)

    def restore(self) -> None:
        self.close()
        shutil.rmtree(self._folder)
        shutil.copytree(self._backup, self._folder)
        self.open()

    def samples(self) -> Iterator[JournalledSample]:
        for row in self._journal.read():
            for i, sample in enumerate(row.rows):
                yield JournalledSample(row.machine, row.spool_id, row.first_seq + i, sample.tobytes())

    def marks(self) -> dict[RunKey, tuple[int, int]]:
        return {run: (mark.seq, mark.lost) for run, mark in self._journal.watermarks().items()}

    @property
    def _journal(self) -> SqliteJournal:
        return self._store.journal

    def open(self) -> None:
        self._plan = FaultPlan()
        self._store = Store(JournalLocation(self._folder), self._site, ServerConfig(), self._now_ns)
        path = self._folder / JOURNAL_FILE
        self._journal._db.close()
        db: Any = sqlite3.connect(path, isolation_level=None, check_same_thread=False, factory=FaultyConnection)
        db.execute("PRAGMA synchronous=FULL")
        db.plan = self._plan
        self._journal._db = db

    def close(self) -> None:
        """Drop the files without closing SQLite: uncommitted data is gone."""
        self._plan.killed = False
        self._plan.disarm()
        self._journal._db.rollback()
        self._store.close()
