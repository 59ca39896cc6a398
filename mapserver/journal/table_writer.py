"""The database-independent part of a journal's writer."""

from __future__ import annotations

import secrets
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from mapserver.journal.records import extent_of, record
from mapserver.journal.rows import (
    Admission,
    Event,
    JournalRow,
    MachineTotals,
    Progress,
    SpoolKey,
    Watermark,
    checksum,
    extent_checksum,
)
from mapserver.journal.shortfall import KIND as SHORTFALL
from mapserver.journal.shortfall import Shortfall
from mapserver.journal.table_queries import TableQueries
from protocol.errors import StoreError
from protocol.version import package_version

PlainEvent = tuple[str, int, Mapping[str, Any]]  # kind, stamp_ns, body
Line = tuple[Any, ...]  # of a table


class TableWriter(TableQueries):
    """`Journal` over tables."""

    shortfall: Shortfall | None = None
    _progress: Progress

    @abstractmethod
    def put_watermark(self, machine: str, spool_id: int, watermark: Watermark) -> None:
        """See `Journal`."""

    @abstractmethod
    def append_events(self, events: Iterable[PlainEvent]) -> int:
        """See `Journal`."""

    @abstractmethod
    def _insert(self, row: int, record: bytes, extent: Line) -> None:
        """Write the next row into the open transaction. extent: with checksum."""

    @property
    def samples(self) -> int:
        """See `Journal`."""
        return self._progress.samples

    def watermark(self, machine: str, spool_id: int) -> Watermark:
        """See `Journal`."""
        return self._progress.watermark(machine, spool_id)

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """See `JournalQueries`."""
        return self._progress.watermarks()

    def machines(self) -> dict[str, MachineTotals]:
        """See `Journal`."""
        return self._progress.machines()

    def append(self, admission: Admission, received_ns: int) -> int:
        """See `Journal`."""
        batch = admission.batch
        row = self.last_row + 1
        written = JournalRow(row, batch.machine, batch.spool_id, batch.first_seq, batch.rows, received_ns)
        extent = (row, *extent_of(batch.rows))
        self._insert(row, record(written), (*extent, extent_checksum(*extent)))
        before = self.watermark(batch.machine, batch.spool_id)
        watermark = Watermark(admission.watermark, before.lost + admission.lost, max(before.newest_ns, extent[2]))
        self.put_watermark(batch.machine, batch.spool_id, watermark)
        return row

    def declare_lost(self, admission: Admission) -> None:
        """See `Journal`."""
        batch = admission.batch
        before = self.watermark(batch.machine, batch.spool_id)
        after = replace(before, seq=admission.watermark, lost=before.lost + admission.lost)
        self.put_watermark(batch.machine, batch.spool_id, after)

    def append_event(self, kind: str, stamp_ns: int, body: Mapping[str, Any]) -> int:
        """See `Journal`."""
        return self.append_events([(kind, stamp_ns, body)])

    def note_shortfall(self, shortfall: Shortfall) -> None:
        """See `Journal`."""
        self.shortfall = shortfall
        newest_ns = max((mark.newest_ns for mark in self.watermarks().values()), default=0)
        self.append_event(SHORTFALL, newest_ns, shortfall.body())

    def _require_meta(self, site: str, frame: str) -> None:
        """StoreError for another site."""
        meta = self._meta()
        for key, value in (("site", site), ("frame", frame)):
            if meta[key] != value:
                problem = (
                    f"the store has {key} {meta[key]!r}, this server {value!r}; choose another --store or --journal"
                )
                raise StoreError(self.where, problem)


def new_meta(schema: int, site: str, frame: str, descends: Iterable[str]) -> list[Line]:
    """Meta lines of a new journal. descends: ids of the stores it is made from."""
    store = " ".join((secrets.token_hex(8), *descends))
    meta = {"schema": str(schema), "version": package_version(), "site": site, "frame": frame, "store": store}
    return [meta_line(*each) for each in meta.items()]


def meta_line(key: str, value: str) -> Line:
    """A meta line with checksum."""
    return key, value, checksum(key, value)


def watermark_line(machine: str, spool_id: int, watermark: Watermark) -> Line:
    """A watermark line with checksum; 64-bit ids as bytes, because databases' integers are signed."""
    values = (machine, spool_id.to_bytes(8, "big"), watermark.seq, watermark.lost, watermark.newest_ns)
    return (*values, checksum(*values))


def event_lines(events: Iterable[PlainEvent], after: int) -> list[Line]:
    """Lines of events, numbered after `after`."""
    numbered = (Event(number, *event) for number, event in enumerate(events, start=after + 1))
    return [(event.id, event.kind, event.stamp_ns, event.text, event.checksum) for event in numbered]
