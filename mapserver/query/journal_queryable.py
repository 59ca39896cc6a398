"""Hands the journal to followers on other hosts: rows from archive and journal, and events, piece by piece.

On a connection and a thread of its own, so that no reader of it holds up ingest or a query of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import zenoh

from mapserver.journal.history import History, read_history
from mapserver.journal.rows import Event, JournalRow
from mapserver.query.answer_pool import AnswerPool
from mapserver.query.queryable import Replies, question
from mapserver.query.region_pieces import PIECE_BYTES
from mapserver.query.source import MapSource
from protocol.errors import QueryError, Refusal, StoreError
from protocol.queries.journal_piece import (
    EventMessage,
    JournalPiece,
    PieceOfJournal,
    RowMessage,
    encode_journal_piece,
    parse_journal_query,
)
from protocol.wire.codec import encode_batch
from protocol.wire.messages import SampleBatch

MOST = 16  # that wait or are in work: one for each follower
ROWS_AT_ONCE, EVENTS_AT_ONCE = 2000, 500  # of one piece, at most


class JournalQueryable:
    """Answers on the key of the journal, until closed."""

    def __init__(self, session: zenoh.Session, key: str, source: MapSource) -> None:
        self._source, self._replies = source, Replies(source)
        self._pool = AnswerPool("journal", 1, MOST)
        self._queryable = session.declare_queryable(key, self._on_query)

    def close(self) -> None:
        """Take no more, and let what is in work end."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]
        self._pool.close()

    def _on_query(self, asked: zenoh.Query) -> None:
        """Wait, without a thread, until there is something new, or for as long as is asked for."""
        try:
            query = parse_journal_query(question(asked)[1])

            def answer(_: QueryError | None) -> None:  # after the wait there may be events, if no row
                self._replies.submit(self._pool, 1, asked, lambda: encode_journal_piece(self.piece(query)))

            self._source.waits.add(query.row + 1 if query.wait_s else 0, query.wait_s, answer)
        except QueryError as error:
            self._replies.refuse(asked, error)

    def piece(self, query: PieceOfJournal) -> JournalPiece:
        """The next rows and events; QueryError where the journal cannot be read."""
        location, site = self._source.location, self._source.site
        try:
            with location.reader() as reader:
                identity, state = reader.identity(), reader.state()
                rows: list[RowMessage] = []
                size = 0
                for part in read_history(History(reader, location.archive), query.row, state.row):
                    for row in part:
                        rows.append(_message(row, site.frame))
                        size += len(rows[-1].batch)
                        if size >= PIECE_BYTES or len(rows) >= ROWS_AT_ONCE:
                            break
                    else:
                        continue
                    break
                events = _messages(reader.events(after=query.event))
                checksums = reader.row_checksum(query.row), reader.event_checksum(query.event)
        except StoreError as error:
            raise QueryError(Refusal.STORE, str(error)) from None
        ends = (state.row, checksums[0], state.event, checksums[1])
        return JournalPiece(identity.id, identity.descends, *ends, tuple(rows), events)


def _messages(events: Sequence[Event]) -> tuple[EventMessage, ...]:
    """The first of some events: as many as one piece may have, and one at least."""
    sizes = accumulate(len(event.text) for event in events)  # MessagePack has up to twice as many
    fit = sum(1 for size in sizes if size <= PIECE_BYTES)
    first = events[: min(max(fit, 1), EVENTS_AT_ONCE)]
    return tuple(EventMessage(event.id, event.kind, event.stamp_ns, event.body) for event in first)


def _message(row: JournalRow, frame: str) -> RowMessage:
    batch = SampleBatch(row.machine, row.spool_id, row.first_seq, row.rows, frame)
    return RowMessage(row.row, row.received_ns, encode_batch(batch))
