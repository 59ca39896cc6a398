"""Pieces of a journal, as a map server hands them to followers (docs/protocol.md, "Journal")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from protocol.errors import MessageError, Refusal
from protocol.queries import parameters as ps
from protocol.queries.answer_codec import MAX_ITEMS, MAX_REPLY_BYTES
from protocol.wire.codec import STORE_ID, check_plain, pack, take, take_store, unpack

MAX_WAIT_S = 60.0
KNOWN = ("row", "event", "wait")


@dataclass(frozen=True)
class PieceOfJournal:
    """What is asked for: rows and events beyond these; wait_s: for a row, where there is none."""

    row: int = 0
    event: int = 0
    wait_s: float = 0.0


@dataclass(frozen=True)
class RowMessage:
    """A journal row. received_ns: the server's clock when it came in; batch: a sample batch, as machines send it."""

    row: int
    received_ns: int
    batch: bytes


@dataclass(frozen=True)
class EventMessage:
    """An event of the journal; body: plain values."""

    id: int
    kind: str
    stamp_ns: int
    body: Mapping[str, Any]


@dataclass(frozen=True)
class JournalPiece:
    """The next rows and events of the journal of a store.

    descends: ids of the stores that it was folded from. last_row, last_event: the last ones that there are. checksum,
    event_checksum: of the row and the event that were asked with, None where that is archived, or not there.
    """

    store: str
    descends: tuple[str, ...]
    last_row: int
    checksum: int | None
    last_event: int
    event_checksum: int | None
    rows: tuple[RowMessage, ...]
    events: tuple[EventMessage, ...]


def encode_journal_query(query: PieceOfJournal) -> dict[str, str]:
    """Selector parameters."""
    return {"row": str(query.row), "event": str(query.event), "wait": ps.text_of(query.wait_s)}


def parse_journal_query(parameters: Mapping[str, str]) -> PieceOfJournal:
    """Undo `encode_journal_query`; QueryError says what is wrong."""
    ps.check_known("journal", parameters, KNOWN)
    row, event = (ps.count(parameters, name) for name in ("row", "event"))
    return PieceOfJournal(row, event, ps.seconds(parameters, "wait", 0.0, MAX_WAIT_S))


def encode_journal_piece(piece: JournalPiece) -> bytes:
    """The answer."""
    return pack(asdict(piece))


def decode_journal_piece(data: bytes) -> JournalPiece:
    """Undo `encode_journal_piece`; a MessageError where the rows or events do not follow each other."""
    table = unpack(data, MAX_REPLY_BYTES, MAX_ITEMS)
    descends = take(table, "descends", list)
    if not all(type(store) is str and STORE_ID.fullmatch(store) for store in descends):
        raise MessageError(Refusal.OUT_OF_RANGE, "not all are ids of stores", field="descends")
    last_row, last_event = (take(table, name, int) for name in ("last_row", "last_event"))
    checksum, event_checksum = (
        None if table.get(name) is None else take(table, name, int) for name in ("checksum", "event_checksum")
    )
    rows = tuple(
        RowMessage(take(row, "row", int), take(row, "received_ns", int), take(row, "batch", bytes))
        for row in _tables(table, "rows")
    )
    events = tuple(map(_event, _tables(table, "events")))
    _require_each([row.row for row in rows], "rows")
    _require_each([event.id for event in events], "events")
    ends = (last_row, checksum, last_event, event_checksum)
    return JournalPiece(take_store(table), tuple(descends), *ends, rows, events)


def _event(table: dict[str, Any]) -> EventMessage:
    body = take(table, "body", dict)
    check_plain(body, "body")
    return EventMessage(take(table, "id", int), take(table, "kind", str), take(table, "stamp_ns", int), body)


def _tables(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    rows: list[Any] = take(table, name, list)
    if not all(type(row) is dict for row in rows):
        raise MessageError(Refusal.WRONG_TYPE, "a list of maps is expected", field=name)
    return rows


def _require_each(numbers: list[int], name: str) -> None:
    if any(after != before + 1 for before, after in pairwise(numbers)):
        raise MessageError(Refusal.OUT_OF_RANGE, "numbers do not follow each other", field=name)
