"""Queries and checks of a journal, in SQL common to all databases."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from itertools import chain
from typing import Any

import numpy as np

from mapserver.journal.journal import ArchivedError, JournalState
from mapserver.journal.records import checksum_of, decoded
from mapserver.journal.rows import (
    ALL,
    LAST,
    Event,
    JournalRow,
    JournalRows,
    Selection,
    SpoolKey,
    StoreIdentity,
    Watermark,
    checksum,
    extent_checksum,
)
from protocol.errors import StoreError

BYTES_AT_ONCE = 2**20  # bytes per piece, to stay in the processor's cache
_EXTENTS_AT_ONCE = 10_000


class TableQueries(ABC):
    """`JournalQueries` over the tables meta, journal, extent, watermark and events.

    Extents have a table of 50 bytes a row, so reads by time and place skip payloads. A flipped bit there would silently
    hide a row, so extents have checksums, checked on opening.
    """

    schema: int  # the only supported one

    @property
    @abstractmethod
    def where(self) -> str:
        """Its location, for people."""

    @property
    @abstractmethod
    def last_row(self) -> int:
        """See `JournalQueries`."""

    @property
    @abstractmethod
    def archived_row(self) -> int:
        """See `JournalQueries`."""

    @abstractmethod
    def state(self) -> JournalState:
        """See `JournalQueries`."""

    @abstractmethod
    def _query(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """All lines of an answer; values are question marks. Raises StoreError."""

    @abstractmethod
    def _piece(self, after: int, until: int, selection: Selection) -> tuple[list[int], list[Any], bool]:
        """Numbers and records of the next rows, about BYTES_AT_ONCE, and whether these are the last."""

    @abstractmethod
    def _one_state(self) -> AbstractContextManager[None]:
        """All reads within see one state."""

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """See `JournalQueries`."""
        return self._load_watermarks()

    def row_checksum(self, row: int) -> int | None:
        """See `JournalQueries`."""
        rows = self._query("SELECT record FROM journal WHERE row = ?", (row,))
        return checksum_of(rows[0][0]) if rows else None

    def event_checksum(self, number: int) -> int | None:
        """See `JournalQueries`."""
        rows = self._query("SELECT crc32 FROM events WHERE id = ?", (number,))
        return int(rows[0][0]) if rows else None

    def read(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRow]:
        """See `JournalQueries`."""
        return chain.from_iterable(self.read_many(after, until, selection))

    def read_many(self, after: int = 0, until: int = LAST, selection: Selection = ALL) -> Iterator[JournalRows]:
        """See `JournalQueries`."""
        while True:
            last = min(until, self.last_row)  # before reading: rows up to this one must be there
            numbers, records, is_end = self._piece(after, until, selection)
            # after reading: rows beyond this one had not been removed
            if after < min(archived := self.archived_row, until):
                raise ArchivedError(self.where, archived)
            there = _dense(numbers, after) if selection.everywhere else len(numbers)
            rows = decoded(numbers[:there], records[:there])
            if len(others := rows.without(selection.without)):
                yield others
            if (n := len(rows)) < there:
                raise self._damaged(f"journal row {numbers[n]}")
            after = numbers[n - 1] if n else after
            if n < len(numbers) or (is_end and selection.everywhere and after < last):
                raise self._damaged(f"what follows number {after}")
            if is_end:
                return

    def stamps_by_chunk(self, after: int, until: int, chunk: int) -> list[tuple[int, int, int]]:
        """See `JournalQueries`."""
        query = "SELECT (row - 1) / ?, MIN(first_stamp_ns), MAX(last_stamp_ns) FROM extent"
        return self._query(f"{query} WHERE row > ? AND row <= ? GROUP BY 1 ORDER BY 1", (chunk, after, until))

    def least_stamp(self, after: int, until: int, from_ns: int) -> int | None:
        """See `JournalQueries`."""
        query = "SELECT MIN(first_stamp_ns) FROM extent WHERE last_stamp_ns >= ? AND row > ? AND row <= ?"
        ((stamp,),) = self._query(query, (from_ns, after, until))
        return None if stamp is None else max(from_ns, int(stamp))

    def rows_before(self, after: int, until: int, stamp_ns: int) -> int:
        """See `JournalQueries`."""
        query = "SELECT COUNT(*) FROM extent WHERE first_stamp_ns < ? AND row > ? AND row <= ?"
        ((count,),) = self._query(query, (stamp_ns, after, until))
        return int(count)

    def identity(self) -> StoreIdentity:
        """See `JournalQueries`."""
        store, *descends = self._meta()["store"].split()
        return StoreIdentity(store, tuple(descends))

    def events(self, kind: str | None = None, after: int = 0) -> list[Event]:
        """See `JournalQueries`."""
        query, values = (
            "SELECT id, kind, stamp_ns, body, crc32 FROM events WHERE id > ?",
            [after, *([kind] if kind else [])],
        )
        rows = self._query(f"{query}{' AND kind = ?' if kind else ''} ORDER BY id", values)
        return [self._event(*values) for values in rows]

    def check(self) -> None:
        """See `JournalQueries`."""
        with self._one_state():
            self.identity()
            self._require_each(self._extent_rows(), self.archived_row, self.last_row)
            self._require_each((event.id for event in self.events()), 0, self.state().event)
            self._load_watermarks()

    def _meta(self) -> dict[str, str]:
        """The table meta; StoreError for another schema, or damage."""
        stated = dict(self._query("SELECT key, value FROM meta WHERE key IN ('schema', 'version')"))
        if (schema := stated.get("schema")) != str(self.schema):
            writer = f"sitegrid {stated['version']}" if "version" in stated else "the version"
            problem = f"has schema {schema!r}, this version knows {self.schema}"
            raise StoreError(self.where, f"{problem}; open it with {writer} that wrote it, or choose another --store")
        meta = {}
        for key, value, crc32 in self._query("SELECT key, value, crc32 FROM meta"):
            if crc32 != checksum(key, value):
                raise self._damaged(f"the {key} of the journal")
            meta[key] = value
        if missing := {"site", "frame", "store"} - meta.keys():
            raise self._damaged(f"the {min(missing)} of the journal")
        return meta

    def _number(self, query: str) -> int:
        ((value,),) = self._query(query)
        try:
            return int(value)
        except ValueError:
            raise self._damaged(f"the value {value!r}") from None

    def _require_each(self, numbers: Iterable[int], after: int, last: int = 0) -> None:
        """StoreError unless numbers are consecutive, from `after` to at least `last`."""
        for number in numbers:
            if number != after + 1:
                raise self._damaged(f"what follows number {after}")
            after = number
        if after < last:
            raise self._damaged(f"what follows number {after}")

    def _damaged(self, what: str) -> StoreError:
        return StoreError(self.where, f"{what} is damaged; restore the file from a backup")

    def _extent_rows(self) -> Iterator[int]:
        """Rows with an extent, in order; in pieces, because there may be millions."""
        query, row = "SELECT * FROM extent WHERE row > ? ORDER BY row LIMIT ?", 0
        while piece := self._query(query, (row, _EXTENTS_AT_ONCE)):
            for *extent, crc32 in piece:
                row = extent[0]
                if crc32 != extent_checksum(*extent):
                    raise self._damaged(f"the extent of journal row {row}")
                yield row

    def _event(self, number: int, kind: str, stamp_ns: int, body: str, crc32: int) -> Event:
        if crc32 != checksum(number, kind, stamp_ns, body):
            raise self._damaged(f"event {number}")
        return Event(number, kind, stamp_ns, json.loads(body))

    def _load_watermarks(self) -> dict[tuple[str, int], Watermark]:
        watermarks = {}
        query = "SELECT machine, spool_id, seq, lost, newest_ns, crc32 FROM watermark"
        for machine, spool, *values, crc32 in self._query(query):
            if crc32 != checksum(machine, spool, *values):
                raise self._damaged(f"the watermark of {machine}")
            watermarks[machine, int.from_bytes(spool, "big")] = Watermark(*values)
        return watermarks


def _dense(numbers: Sequence[int], after: int) -> int:
    """Number of leading consecutive numbers."""
    gaps = np.flatnonzero(np.array(numbers, np.int64) != np.arange(after + 1, after + 1 + len(numbers)))
    return int(gaps[0]) if len(gaps) else len(numbers)


def size_of(records: Sequence[Any]) -> int:
    """Total bytes."""
    try:
        return sum(map(len, records))
    except TypeError:  # damage may change a value's type
        return BYTES_AT_ONCE
