"""Planted bugs, plausible mistakes; a simulation that misses them proves nothing."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from agents.delivery import uplink_thread
from agents.delivery.spool import Spool, SpoolRun
from agents.delivery.uplink import Action, Send, Uplink
from agents.delivery.uplink_thread import Ask
from agents.delivery.write_buffer import WriteBuffer
from mapserver.journal.rows import Admission
from protocol.errors import StoreError
from protocol.machine.samples import empty
from protocol.wire.messages import Ack, Refused, SampleBatch
from tests.delivery_simulation import servers
from tests.delivery_simulation.faults import Fault
from tests.delivery_simulation.servers import ModelServer

Plant = Callable[[pytest.MonkeyPatch], None]


def ack_before_commit(patch: pytest.MonkeyPatch) -> None:
    """The server replies before it dies or its disk fills."""

    def commit(self: ModelServer, new: Any, answers: list[Ack | Refused], fault: Fault | None) -> list[Ack | Refused]:
        if fault is None or fault == Fault.KILLED_AFTER:
            self.disk = new
        return answers

    patch.setattr(ModelServer, "commit", commit)


def watermark_one_too_low(patch: pytest.MonkeyPatch) -> None:
    """The server takes the last committed sample for the next expected."""
    admit = servers.admit
    patch.setattr(servers, "admit", lambda batch, watermark: admit(batch, max(0, watermark - 1)))


def watermark_one_too_high(patch: pytest.MonkeyPatch) -> None:
    """The acknowledgement names the next sample instead of the last."""
    patch.setattr(Admission, "watermark", property(lambda self: self.batch.last_seq + 1))


def delete_before_ack(patch: pytest.MonkeyPatch) -> None:
    """The agent deletes what it sent instead of what arrived."""
    perform = uplink_thread.perform

    def sent_is_done(action: Action, uplink: Uplink, spool: Spool, ask: Ask) -> Action:
        head = uplink._head
        if isinstance(action, Send) and head and len(head.rows):
            spool.acknowledge(head.spool_id, head.first_seq + len(head.rows) - 1)
        return perform(action, uplink, spool, ask)

    patch.setattr(uplink_thread, "perform", sent_is_done)


def _plant_admit(patch: pytest.MonkeyPatch, wrong: Callable[[SampleBatch, int], SampleBatch]) -> None:
    admit = servers.admit

    def admit_wrongly(batch: SampleBatch, watermark: int) -> Admission:
        overlaps = len(batch.rows) and batch.first_seq <= watermark < batch.last_seq
        return Admission(wrong(batch, watermark), 0, 0) if overlaps else admit(batch, watermark)

    patch.setattr(servers, "admit", admit_wrongly)


def trim_whole_batch(patch: pytest.MonkeyPatch) -> None:
    """A batch that starts with known samples counts as known entirely."""

    def known(batch: SampleBatch, watermark: int) -> SampleBatch:
        return replace(batch, first_seq=batch.last_seq + 1, rows=batch.rows[:0])

    _plant_admit(patch, known)


def trim_nothing(patch: pytest.MonkeyPatch) -> None:
    """A batch that ends with new samples counts as new entirely."""
    _plant_admit(patch, lambda batch, watermark: batch)


def gap_is_accepted(patch: pytest.MonkeyPatch) -> None:
    """A batch beyond the next expected sample is accepted without counting the gap."""
    admit = servers.admit

    def admit_gap(batch: SampleBatch, watermark: int) -> Admission:
        is_gap = len(batch.rows) and batch.first_seq - watermark - 1 > batch.lost_before
        return Admission(batch, 0, 0) if is_gap else admit(batch, watermark)

    patch.setattr(servers, "admit", admit_gap)


def one_identity_for_ever(patch: pytest.MonkeyPatch) -> None:
    """A reopened or copied spool keeps its spool_id."""
    start_run = Spool._start_run

    def go_on(self: Spool) -> list[SpoolRun]:
        first = self._db.execute("SELECT spool_id, acknowledged FROM run WHERE base = 0").fetchone()
        if not first:
            return start_run(self)
        return [SpoolRun(0, int(first[0], 16), first[1])]

    patch.setattr(Spool, "_start_run", go_on)


def commit_is_assumed(patch: pytest.MonkeyPatch) -> None:
    """The spool counts on although the disk took nothing."""
    write = Spool._write

    def count_first(self: Spool, rows: Any, *more: Any) -> None:
        try:
            write(self, rows, *more)
        except Exception:
            self._meta = replace(self._meta, newest=self._meta.newest + len(rows))
            raise

    patch.setattr(Spool, "_write", count_first)


def pending_are_sent(patch: pytest.MonkeyPatch) -> None:
    """The uplink sends samples without final value."""
    patch.setattr(Spool, "_last_final", Spool._end)


def final_values_find_others(patch: pytest.MonkeyPatch) -> None:
    """Final values go to the newest pending samples instead of the oldest."""
    write = Spool._write

    def misplace(self: Spool, rows: Any, finals: Any, oldest: int, pending: int) -> None:
        write(self, rows, finals, self._meta.newest - len(finals) + 1, pending)

    patch.setattr(Spool, "_write", misplace)


def final_values_are_given_up(patch: pytest.MonkeyPatch) -> None:
    """A final value refused by a full disk is forgotten; its sample blocks all later ones."""
    write = WriteBuffer.write

    def forget(self: WriteBuffer, spool: Spool) -> int:
        try:
            return write(self, spool)
        except StoreError:
            self._finals = empty()
            raise

    patch.setattr(WriteBuffer, "write", forget)


def failed_commit_stays_open(patch: pytest.MonkeyPatch) -> None:
    """A failed commit is not rolled back."""

    @contextmanager
    def careless(db: sqlite3.Connection) -> Iterator[None]:
        db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            db.execute("ROLLBACK")
            raise
        db.execute("COMMIT")

    patch.setattr("agents.delivery.spool.transaction", careless)


def drops_are_silent(patch: pytest.MonkeyPatch) -> None:
    """A full spool drops without counting."""
    save = Spool._save
    patch.setattr(Spool, "_save", lambda self, meta: save(self, replace(meta, dropped=0)))
    patch.setattr(Spool, "counters", lambda self: {"depth": self._depth, "dropped": 0, "put_aside": self._quarantined})


_PLANTS: tuple[Plant, ...] = (
    *(ack_before_commit, watermark_one_too_low, watermark_one_too_high, delete_before_ack),
    *(trim_whole_batch, trim_nothing, gap_is_accepted, one_identity_for_ever),
    *(commit_is_assumed, failed_commit_stays_open, drops_are_silent),
    *(pending_are_sent, final_values_find_others, final_values_are_given_up),
)
BUGS = {plant.__name__: plant for plant in _PLANTS}
