"""What a journal is, whatever keeps it: the seam between a map server and its database.

A journal holds what machines sent, in rows that are numbered 1, 2, 3... in the order of their commits, a watermark per
spool, and events. One writer has it, any number of readers look. Nothing outside of the folders that implement this
knows which database it is (`location.py` does), nor catches its errors: all are one of those here.
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

ROWS_AT_ONCE = 200  # read or removed in one transaction: short ones hold nobody up


class ArchivedError(StoreError):
    """Rows that are asked for have moved to the archive. archived_row: the last one that has."""

    def __init__(self, where: object, archived_row: int) -> None:
        super().__init__(where, f"rows up to {archived_row} are in the archive beside it")
        self.archived_row = archived_row


class UnwrittenError(StoreError):
    """A transaction failed, as on a full disk: after `rollback` the journal is as it is on disk, and goes on.

    problem: what the database says, without where it is. unsure: it may have been committed all the same, since the
    answer is lost.
    """

    def __init__(self, where: object, problem: str, *, unsure: bool = False) -> None:
        super().__init__(where, problem)
        self.problem, self.unsure = problem, unsure


class FencedError(UnwrittenError):
    """Another server has taken over the journal: this one acknowledges nothing any more, and ends."""


@dataclass(frozen=True)
class JournalState:
    """How far a journal is. epoch: number of its writer, each has a higher one; row, event: the last ones."""

    epoch: int
    row: int
    event: int


class JournalQueries(Protocol):
    """What can be read of a journal, by its writer as by a reader."""

    @property
    def where(self) -> str:
        """Where it is, for people."""

    @property
    def last_row(self) -> int:
        """The last row, archived or not."""

    @property
    def archived_row(self) -> int:
        """The last row that has moved to the archive."""

    @property
    def schema(self) -> int:
        """Number of its tables' form."""

    @property
    def replica(self) -> str:
        """What stands behind the disk: "synchronous" where a commit waits for another machine's disk too.

        "asynchronous" where another one follows without that, else "none".
        """

    def identity(self) -> StoreIdentity:
        """Which store this is; StoreError where that is damaged."""

    def state(self) -> JournalState:
        """How far it is now."""

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """Progress of all spools."""

    def read(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRow]:
        """As `read_many`, one by one."""

    def read_many(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRows]:
        """Rows after < row <= until in order, also those that are committed meanwhile; many at a time, and never none.

        StoreError where a row is missing or not what was written, after those before it; ArchivedError as soon as one
        of them is archived.
        """

    def row_checksum(self, row: int) -> int | None:
        """The checksum that a row was written with; None where it is not there, or archived.

        Who has seen a row knows by this whether the journal still has it, or was restored and went another course.
        """

    def event_checksum(self, number: int) -> int | None:
        """As `row_checksum`, of an event."""

    def events(self, kind: str | None = None, after: int = 0) -> list[Event]:
        """Events beyond the number `after`, of one kind or of all, in the order in which they were written."""

    def stamps_by_chunk(self, after: int, until: int, chunk: int) -> list[tuple[int, int, int]]:
        """Chunks of so many rows among after < row <= until: number, least and greatest stamp of each."""

    def least_stamp(self, after: int, until: int, from_ns: int) -> int | None:
        """The least stamp of rows after < row <= until, `from_ns` of a row that reaches across it; None for none."""

    def rows_before(self, after: int, until: int, stamp_ns: int) -> int:
        """How many of the rows after < row <= until have a stamp before a time; of archived ones none is counted."""

    def check(self) -> None:
        """Check identity, extents, events and watermarks; StoreError where one is damaged.

        Rows are checked when they are read. A damaged extent would hide its row from a read by time and place, without
        any error.
        """

    def close(self) -> None:
        """Close it; nothing is asked of it from then on."""


class JournalReader(JournalQueries, Protocol):
    """Reads a journal also while a server writes it; used by one thread at a time. site, frame: whose it is."""

    site: str
    frame: str

    def complete_s(self) -> float:
        """When, by the steady clock, what can be read now was all that was journalled; negative infinity where unknown.

        That is now, but where it is read from a replica of a database, which may be behind.
        """

    @property
    def is_replica(self) -> bool:
        """Whether it reads from a replica of a database: the next connection may be to one that is further behind."""

    def follow(self, known: JournalState, timeout_s: float) -> JournalState:
        """Wait until the journal is not as known any more, or for so long; returns how far it is then."""

    def __enter__(self) -> Self:
        """Use it."""

    def __exit__(self, *_: object) -> None:
        """Close it."""


class Waiting(Protocol):
    """What a server does while another one writes its journal."""

    def follow(self, timeout_s: float) -> None:
        """Do it for so long; what it raises ends the wait."""

    def has_checked(self, journal: JournalQueries) -> bool:
        """Whether that was done meanwhile which `JournalQueries.check` does, and need not be done again."""


class Journal(JournalQueries, Protocol):
    """One writer's connection to the journal of one site.

    Transactions: what fails raises UnwrittenError, and `rollback` is called then. shortfall: what was acknowledged and
    was not in it when it was opened now, None where nothing is missing. samples: that all machines sent.
    """

    shortfall: Shortfall | None

    @property
    def epoch(self) -> int:
        """Its number among all writers of this journal, higher than that of those before."""

    @property
    def fenced(self) -> str:
        """Why it may not write any more since another server does, empty while it may; for any thread."""

    @property
    def trusted_row(self) -> int:
        """What the server's folder has of rows up to this one, snapshots and checkpoints, is of this journal."""

    @property
    def samples(self) -> int:
        """How many samples all machines sent."""

    def watermark(self, machine: str, spool_id: int) -> Watermark:
        """Progress of a spool."""

    def machines(self) -> dict[str, MachineTotals]:
        """What each machine sent."""

    def begin(self) -> None:
        """Open a transaction; rows appended from here on are one group commit.

        There may be rows then that were committed though an error said otherwise, as the answer of a database was lost.
        """

    def append(self, admission: Admission, received_ns: int) -> int:
        """Write one row and its watermark into the open transaction; returns the row's number."""

    def declare_lost(self, admission: Admission) -> None:
        """Write a watermark alone into the open transaction: samples at a spool's end that will never come."""

    def commit(self) -> None:
        """Commit to disk; only then may anything be acknowledged."""

    def rollback(self) -> None:
        """Give up the open transaction, if there is one, and return to what is on disk."""

    def append_event(self, kind: str, stamp_ns: int, body: Mapping[str, Any]) -> int:
        """Commit an event, outside of any other transaction; returns its number."""

    def append_events(self, events: Iterable[tuple[str, int, Mapping[str, Any]]]) -> int:
        """Commit events (kind, stamp_ns, body), all or none, outside of other transactions; returns the last number.

        The number is 0 where there never was an event.
        """

    def note_shortfall(self, shortfall: Shortfall) -> None:
        """Keep what is missing as an event; no file that proves it is needed from then on."""

    def forget(self, until: int, most: int = ROWS_AT_ONCE) -> int:
        """Remove the next rows up to `until`, which are archived, and commit; returns the new `archived_row`.

        most: how many at most, so that batches need not wait long; call it again until `until` is reached.
        """

    def shrink(self) -> int:
        """Give free room back to the disk, a piece at a time; returns how many pages."""
