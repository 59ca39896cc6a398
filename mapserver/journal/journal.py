"""The journal: the interface of a map server to its database.

It holds rows of samples, numbered 1, 2, 3... by commit, a watermark per spool, and events, for one writer and many
readers. Only implementing folders and `location.py` know the database; its errors become those below.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

from mapserver.journal.rows import (
    ALL,
    LAST,
    Admission,
    Event,
    JournalRow,
    JournalRows,
    MachineTotals,
    Selection,
    SpoolKey,
    StoreIdentity,
    Watermark,
)
from mapserver.journal.shortfall import Shortfall
from protocol.errors import StoreError

ROWS_AT_ONCE = 200  # rows per transaction, kept short for others


class ArchivedError(StoreError):
    """Requested rows are in the archive. archived_row: the last archived one."""

    def __init__(self, where: object, archived_row: int) -> None:
        super().__init__(where, f"rows up to {archived_row} are in the archive beside it")
        self.archived_row = archived_row


class UnwrittenError(StoreError):
    """A transaction failed, as on a full disk; after `rollback` the journal continues.

    problem: the database's message, without location. unsure: the answer was lost; it may be committed.
    """

    def __init__(self, where: object, problem: str, *, unsure: bool = False) -> None:
        super().__init__(where, problem)
        self.problem, self.unsure = problem, unsure


class FencedError(UnwrittenError):
    """Another server has taken over the journal; this one ends."""


@dataclass(frozen=True)
class JournalState:
    """Progress of a journal. epoch: of its writer, ever higher; row, event: the last ones."""

    epoch: int
    row: int
    event: int


class JournalQueries(Protocol):
    """Queries of a journal, for its writer and readers."""

    @property
    def where(self) -> str:
        """Its location, for people."""

    @property
    def last_row(self) -> int:
        """The last row, archived or not."""

    @property
    def archived_row(self) -> int:
        """The last archived row."""

    @property
    def schema(self) -> int:
        """Schema number of its tables."""

    @property
    def replica(self) -> str:
        """Replication: "synchronous" if commits wait for another disk, "asynchronous" if one follows, else "none"."""

    def identity(self) -> StoreIdentity:
        """The store's identity; StoreError if damaged."""

    def state(self) -> JournalState:
        """Present progress."""

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """Progress of all spools."""

    def read(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRow]:
        """As `read_many`, one by one."""

    def read_many(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRows]:
        """Rows after < row <= until in order, also new ones, in non-empty pieces.

        StoreError at a missing or damaged row, after those before; ArchivedError as soon as one is archived.
        """

    def row_checksum(self, row: int) -> int | None:
        """A row's checksum, by which readers notice that a journal has diverged; None if missing or archived."""

    def event_checksum(self, number: int) -> int | None:
        """As `row_checksum`, for an event."""

    def events(self, kind: str | None = None, after: int = 0) -> list[Event]:
        """Events numbered above `after`, of one kind or all, in order."""

    def stamps_by_chunk(self, after: int, until: int, chunk: int) -> list[tuple[int, int, int]]:
        """Number, least and greatest stamp of each chunk of rows in after < row <= until."""

    def least_stamp(self, after: int, until: int, from_ns: int) -> int | None:
        """The least stamp of rows after < row <= until, or from_ns if a row spans it; None for none."""

    def rows_before(self, after: int, until: int, stamp_ns: int) -> int:
        """Number of unarchived rows after < row <= until with a stamp before a time."""

    def check(self) -> None:
        """Check identity, extents, events and watermarks; StoreError for damage.

        Rows are checked on reading, but a damaged extent would silently hide its row.
        """

    def close(self) -> None:
        """Close it."""


class JournalReader(JournalQueries, Protocol):
    """Reads a journal while a server may write it; for one thread at a time. site, frame: its own."""

    site: str
    frame: str

    def complete_s(self) -> float:
        """Monotonic time at which the readable rows were complete: now, or earlier on a replica; -inf if unknown."""

    @property
    def is_replica(self) -> bool:
        """Whether it reads a database replica; the next one may lag further."""

    def follow(self, known: JournalState, timeout_s: float) -> JournalState:
        """Wait for progress beyond `known`, or a timeout; returns the progress."""

    def __enter__(self) -> Self:
        """Use it."""

    def __exit__(self, *_: object) -> None:
        """Close it."""


class Waiting(Protocol):
    """What a server does while another one writes its journal."""

    def follow(self, timeout_s: float) -> None:
        """Do it for a while; exceptions end the wait."""

    def has_checked(self, journal: JournalQueries) -> bool:
        """Whether it has already done the work of `JournalQueries.check`."""


class Journal(JournalQueries, Protocol):
    """The writer's connection to a journal.

    Failed transactions raise UnwrittenError; call `rollback` then. shortfall: data missing on opening, or None.
    samples: of all machines.
    """

    shortfall: Shortfall | None

    @property
    def epoch(self) -> int:
        """Number of this writer; later ones have higher numbers."""

    @property
    def fenced(self) -> str:
        """Why another server has taken over, or ""; thread-safe."""

    @property
    def trusted_row(self) -> int:
        """Last row up to which snapshots and checkpoints in the server's folder belong to this journal."""

    @property
    def samples(self) -> int:
        """Samples sent by all machines."""

    def watermark(self, machine: str, spool_id: int) -> Watermark:
        """Progress of a spool."""

    def machines(self) -> dict[str, MachineTotals]:
        """What each machine sent."""

    def begin(self) -> None:
        """Open a transaction, a group commit. Earlier rows may have been committed although the answer was lost."""

    def append(self, admission: Admission, received_ns: int) -> int:
        """Write a row and its watermark into the open transaction; returns its number."""

    def declare_lost(self, admission: Admission) -> None:
        """Write only a watermark: samples at a spool's end are lost."""

    def commit(self) -> None:
        """Commit to disk, before anything is acknowledged."""

    def rollback(self) -> None:
        """Abort any open transaction and return to what is on disk."""

    def append_event(self, kind: str, stamp_ns: int, body: Mapping[str, Any]) -> int:
        """Commit an event, outside of transactions; returns its number."""

    def append_events(self, events: Iterable[tuple[str, int, Mapping[str, Any]]]) -> int:
        """Commit events (kind, stamp_ns, body), all or none, outside of transactions; returns the last number, or 0."""

    def note_shortfall(self, shortfall: Shortfall) -> None:
        """Store missing data as an event, in place of files that prove it."""

    def forget(self, until: int, most: int = ROWS_AT_ONCE) -> int:
        """Remove archived rows up to `until` and commit; returns the new `archived_row`.

        At most `most`, so that batches need not wait; repeat until `until`.
        """

    def shrink(self) -> int:
        """Return some free space to the disk; returns the number of pages."""
