"""The store of one site: journal, grid and snapshots. Owned by one thread (see writer.py)."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapserver.config import ServerConfig
from mapserver.evidence.fold_config import name_hash
from mapserver.evidence.grid import Grid
from mapserver.ingest.admission import GapError, SeenTime, Verify, admit, check_store, judge_batch, signature_problem
from mapserver.ingest.batches import decode_batches
from mapserver.ingest.block_credit import BlockCredit
from mapserver.ingest.decisions import Decision, Decisions, plain
from mapserver.ingest.map_info import by_machine, map_info, name_shortfalls
from mapserver.ingest.standby import Standby
from mapserver.ingest.store_folder import hold
from mapserver.journal.facts import Facts
from mapserver.journal.history import History, fold_history, read_history, release_memory
from mapserver.journal.journal import FencedError, UnwrittenError
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission, Selection
from mapserver.past.checkpoint_file import OPEN_END_NS
from mapserver.past.checkpoints import remove_beyond, save_snapshot, snapshot_rows
from mapserver.past.past import StorePast
from mapserver.roads.repair_facts import RoadRepair
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import joined
from protocol.queries.answers import MapVersion
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import Ack, Refused, SampleBatch

log = logging.getLogger("mapserver.ingest.store")
ACCEPTED = "accepted_store"  # event kind


@dataclass(frozen=True)
class Incoming:
    """A received batch: machine of its key, bytes, and signature, if any."""

    machine: str
    payload: bytes
    signature: bytes = b""


class Store:
    """Journal, grid, watermarks and counters of one site.

    identity: of this store; accepted: ids it replaces. facts, merged: of the grid, its last row. newest_ns: the site's
    now.
    """

    def __init__(
        self,
        location: JournalLocation,
        site: SiteConfig,
        config: ServerConfig,
        now_ns: Callable[[], int],
        verify: Verify | None = None,
        standby: Standby | None = None,
    ) -> None:
        """verify: raises MessageError unless a batch is signed. standby: follows a shared journal until take-over."""
        folder = location.folder
        self.site, self.config, self.location, self.now_ns = site, config, location, now_ns
        self._verify = verify
        self.counters: Counter[str] = Counter()
        self.commits, self.commit_s = 0, 0.0
        with ExitStack() as opened:
            opened.enter_context(hold(folder))
            self.journal = location.open(site.name, site.frame, waiting=standby)
            opened.callback(self.journal.close)
            self.history = History(self.journal, location.archive)
            self.identity = self.journal.identity()
            self.accepted = frozenset(event.body["store"] for event in self.journal.events(ACCEPTED))
            self._decisions, last_row = Decisions.of_journal(self.journal, site.cell_m), self.journal.last_row
            self.facts = facts = self._decisions.facts
            self.shortfalls = name_shortfalls(self.journal, snapshot_rows(folder))
            remove_beyond(folder, self.journal.trusted_row)
            self._past = StorePast.of_store(folder, site.cell_m, config.fold)
            warm = standby.grid_for(self.journal, facts) if standby else None
            self.merged, self.grid = warm or self._past.newest(self.journal, facts)
            self.snapshot_row = 0 if warm else self.merged
            in_snapshot = self.grid.counts()
            fold_history(self.grid, self.history, self.merged, selection=Selection.by(facts))
            release_memory()
            self._credit = self._new_credit()
            self.merged, counts = last_row, self.grid.counts()
            tail = counts.folded + counts.skipped - in_snapshot.folded - in_snapshot.skipped
            self._snapshot_samples = 0 if warm else self.journal.samples - tail  # a warm grid is on no disk yet
            self._newest = {name: entry["newest_ns"] for name, entry in self.machines().items()}
            self._received_ns = self._last_received(last_row)
            self._opened = opened.pop_all()

    @property
    def journalled(self) -> int:
        """The last row on disk."""
        return self.journal.last_row

    @property
    def samples_behind(self) -> int:
        """Samples missing from the newest snapshot, which a start would fold."""
        return self.journal.samples - self._snapshot_samples

    @property
    def newest_ns(self) -> int:
        """The site's now: newest stamp of machines in the map, 0 for none."""
        return self._newest_but("")

    @property
    def version(self) -> MapVersion:
        """The map's version."""
        return MapVersion(self.identity.id, self.merged, self.fact)

    @property
    def fact(self) -> int:
        """Number of the last decision in the grid."""
        return self.facts.number

    def commit(self, group: list[Incoming]) -> list[Ack | Refused]:
        """Journal a group of batches in one commit, fold it, and return the answers.

        Acknowledged after the commit; if it fails, all are refused.
        """
        batches = self._decode(group)
        try:
            self.journal.begin()
            self._catch_up()
            answers = [self._admit(incoming, batch) for incoming, batch in zip(group, batches, strict=True)]
            began_s = time.monotonic()
            self.journal.commit()
            self.commits, self.commit_s = self.commits + 1, self.commit_s + time.monotonic() - began_s
        except UnwrittenError as error:
            self.journal.rollback()
            self._credit = self._new_credit()
            if isinstance(error, FencedError):
                raise
            self.counters[f"refused_{Refusal.STORE}"] += len(group)
            return [Refused(Refusal.STORE, f"the server cannot write: {error.problem}") for _ in group]
        for answer, admission in answers:
            self._count(answer, admission)
        self._fold([admission.batch for _, admission in answers if admission and len(admission.batch.rows)])
        return [answer for answer, _ in answers]

    def save_snapshot(self) -> None:
        """Write a snapshot of the present grid."""
        if write := self.snapshot():
            write()

    def snapshot(self) -> Callable[[], None] | None:
        """Take a snapshot; returns its writer, for any thread, or None if nothing is new."""
        if self.merged <= self.snapshot_row:
            return None
        row, grid, samples, state = self.merged, self.grid, self.journal.samples, self.grid.state()
        facts = self._past.depends_on(self.journal, self.facts)(OPEN_END_NS)

        def write() -> None:
            save_snapshot(self.location.folder, row, facts, state)
            if self.grid is grid:  # otherwise another grid was adopted, without a snapshot
                self.snapshot_row, self._snapshot_samples = row, samples

        return write

    def adopt(self, grid: Grid, row: int, facts: Facts) -> None:
        """Continue with a grid folded elsewhere, with these facts, up to a row.

        Batches wait while later rows are folded, so let them be few.
        """
        grid.touch_all()
        selection = Selection.by(facts)
        for rows in read_history(self.history, after=row, selection=selection):
            grid.fold_all(*rows.selected(selection))
        self.grid, self.facts = grid, facts
        self._count_decisions()
        self.snapshot_row = self._snapshot_samples = 0  # the snapshot has other facts

    def decide(self, *decisions: Decision) -> Facts:
        """Store decisions, all or none; returns the facts to follow.

        They apply at once, unless the map must be rebuilt.
        """
        self._decisions.add(decisions, self.journal.append_events(map(plain, decisions)))
        self._count_decisions()
        return self._decisions.facts

    def repair(self, version: MapVersion, events: Sequence[RoadRepair]) -> bool:
        """Store repairs found in a version of the map, and withdrawals; False if it has other facts by now."""
        self._decisions.hear(self.journal.events(after=self.decided), self.journal.where)  # answers may get lost
        self._count_decisions()
        known = (self.identity.id, self.fact, self.decided) == (version.store, version.fact, version.fact)
        if known and version.row <= self.merged:
            self.decide(*events)
            return True
        return False

    def confirm(self, confirmed: Mapping[str, int]) -> None:
        """Date offers to machines: the solver confirms them, as of when [ns]."""
        self._decisions.calibration.confirm(confirmed)

    def accept(self, store: str, reason: str) -> None:
        """Replace another store for good, as a person says; its runs continue here."""
        if store != self.identity.id and store not in self.accepted:
            self.journal.append_event(ACCEPTED, self.newest_ns, {"store": store, "reason": reason})
            self.accepted |= {store}
            log.warning("accepted store=%s reason=%r", store, reason)

    def close(self) -> None:
        """Close the journal and release the folder."""
        self._opened.close()

    def info(self) -> dict[str, Any]:
        """State in plain values, from counters."""
        info = map_info(self.site, self.grid, self.facts, self.version, self.newest_ns, self.now_ns())
        return info | {
            "descends": list(self.identity.descends),
            "accepted": sorted(self.accepted),
            "epoch": self.journal.epoch,
            "replica": self.journal.replica,
            "decided": self.decided,
            "journalled": self.journalled,
            "snapshot": self.snapshot_row,
            "machines": self.machines(),
            "shortfalls": [str(shortfall) for shortfall in self.shortfalls],
            "counters": dict(self.counters),
        }

    @property
    def decided(self) -> int:
        """Number of the last stored decision, followed or not."""
        return self._decisions.facts.number

    def machines(self) -> dict[str, dict[str, int]]:
        """See `by_machine`."""
        return by_machine(self.journal, self.shortfalls)

    def _decode(self, group: list[Incoming]) -> list[SampleBatch | MessageError]:
        """Each batch, or why it is refused; unsigned batches are not decoded."""
        sent = ((incoming.machine, incoming.payload, incoming.signature) for incoming in group)
        refused = [signature_problem(self._verify, self.site.name, *each) if self._verify else None for each in sent]
        signed = (incoming.payload for incoming, error in zip(group, refused, strict=True) if error is None)
        decoded = iter(decode_batches(list(signed), self.site.extent_m))
        return [error or next(decoded) for error in refused]

    def _admit(self, incoming: Incoming, batch: SampleBatch | MessageError) -> tuple[Ack | Refused, Admission | None]:
        try:
            if isinstance(batch, MessageError):
                raise batch
            judge_batch(batch, incoming.machine, self.site, self.now_ns, self._seen)
            replaces = check_store(batch, self.identity, self.accepted)
            admission = admit(batch, self.journal.watermark(batch.machine, batch.spool_id).seq)
            if new := len(admission.batch.rows) > 0:
                self._credit.spend(batch.machine, admission.batch.rows, admission.trimmed, self.now_ns())
        except MessageError as error:
            expected = error.expected if isinstance(error, GapError) else 0
            return Refused(error.reason, str(error), expected), None
        if new:
            self._received_ns = self.now_ns()
        row = self.journal.append(admission, self._received_ns) if new else self.journalled
        if admission.lost and not new:
            self.journal.declare_lost(admission)
        offer = self._decisions.offer(batch.machine) if new else None
        return Ack(
            admission.watermark, row, admission.trimmed, self.identity.id, replaces, offer, self.journal.epoch
        ), admission

    def _newest_but(self, machine: str) -> int:
        """Newest stamp of machines in the map, except one."""
        hidden = self.facts.excluded | {machine}
        return max((newest_ns for name, newest_ns in self._newest.items() if name not in hidden), default=0)

    def _seen(self, machine: str) -> SeenTime:
        return SeenTime(self._newest_but(machine), self.newest_ns, self._received_ns)

    def _last_received(self, last_row: int) -> int:
        """Server time of the last row, 0 for none in the journal."""
        is_there = last_row > self.journal.archived_row
        return max((row.received_ns for row in self.journal.read(after=last_row - 1)), default=0) if is_there else 0

    def _new_credit(self) -> BlockCredit:
        """Accounts for the present map, without what a failed commit spent."""
        opened, signed = self.grid.folded_since(-1)[0], self._verify is not None
        return BlockCredit(self.site.cell_m, self.config.fold, opened, self.journal.machines(), signed=signed)

    def _count(self, answer: Ack | Refused, admission: Admission | None) -> None:
        """Count a batch's final outcome."""
        if isinstance(answer, Refused):
            self.counters[f"refused_{answer.reason}"] += 1
        elif admission:
            self.counters["batches"] += len(admission.batch.rows) > 0
            self.counters["samples_trimmed"] += admission.trimmed
            self.counters["samples_lost"] += admission.lost
            if admission.lost:
                log.warning("declared lost machine=%s samples=%d", admission.batch.machine, admission.lost)

    def _fold(self, batches: list[SampleBatch]) -> None:
        """Fold committed batches, up to the last row."""
        folded = [batch for batch in batches if batch.machine not in self.facts.excluded]
        names = np.array([name_hash(batch.machine) for batch in folded], np.uint64)
        machine = np.repeat(np.arange(len(folded)), [len(batch.rows) for batch in folded])
        rows = joined([batch.rows for batch in folded])
        self.grid.fold_all(self.facts.corrections.applied(rows, [b.machine for b in folded], machine), names[machine])
        for batch in batches:
            newest_ns = int(batch.rows["stamp_ns"].max())
            self._newest[batch.machine] = max(self._newest.get(batch.machine, 0), newest_ns)
        self.merged = self.journalled

    def _catch_up(self) -> None:
        """Fold rows that were committed although the database's answer was lost."""
        if self.journal.last_row > self.merged:
            selection = Selection.by(self.facts)
            for rows in read_history(self.history, after=self.merged, selection=selection):
                self.grid.fold_all(*rows.selected(selection))
            self._newest |= {name: totals.newest_ns for name, totals in self.journal.machines().items()}
            log.warning("committed without an answer rows=%d", self.journal.last_row - self.merged)
            self.merged = self.journal.last_row

    def _count_decisions(self) -> None:
        """Adopt number and repairs of decisions that lead to the grid's facts."""
        if self._decisions.facts == self.facts:
            self.grid.renew(self.facts.repairs.differing(self._decisions.facts.repairs))
            self.facts = self._decisions.facts
