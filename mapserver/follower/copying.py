"""A copy of the journal of a map server on another host, kept up to date over Zenoh: a follower reads that.

It is a journal as any, with the store's own id and the server's numbers: one that is behind goes on where it is, and
maps of the past are read from it. Where the server's journal went another course, the copy is made anew.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import zenoh

from mapserver.evidence import snapshot
from mapserver.follower.following import is_other
from mapserver.ingest.batches import decode_batches
from mapserver.ingest.store_folder import hold
from mapserver.journal.journal import Journal
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission, StoreIdentity
from mapserver.past import checkpoints
from protocol.errors import MessageError, SitegridError, StoreError
from protocol.queries.journal_piece import JournalPiece, PieceOfJournal, decode_journal_piece, encode_journal_query
from protocol.queries.parameters import selector_of
from protocol.site.site_config import SiteConfig
from protocol.wire import keys

WAIT_S = 1.0  # the server waits so long for a row; decisions and changes come then at the latest
ANSWER_S = 20.0
AGAIN_S = 0.5
MOST_OFTEN_S = 0.05  # a question takes the server a millisecond, and what comes meanwhile comes together
log = logging.getLogger("mapserver.follower.copying")


class Copying:
    """A thread that keeps a copy. ended: why it has given up, empty while it goes on."""

    def __init__(self, session: zenoh.Session, site: SiteConfig, folder: Path) -> None:
        """StoreError where another process has the folder."""
        self.location, self.ended = JournalLocation(folder), ""
        self._session, self._site, self._folder = session, site, folder
        self._held = ExitStack()
        self._held.enter_context(hold(folder))
        self._known = (0, float("-inf"))
        self._journal: Journal | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="copying", daemon=True)

    @property
    def known(self) -> tuple[int, float]:
        """The last row of the server's journal, and when it was asked for it, by the steady clock [s]."""
        return self._known

    def start(self) -> None:
        """Copy from now on."""
        self._thread.start()

    def stop(self) -> None:
        """Have the thread end soon."""
        self._ending.set()

    def close(self) -> None:
        """End the thread, and close the copy."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._journal:
            self._journal.close()
        self._held.close()

    def _run(self) -> None:
        problem = ""
        try:
            if self.location.exists():
                self._journal = self.location.open(self._site.name, self._site.frame)
                if self._journal.shortfall:  # what is missing of a copy is no event of the server's
                    self._discard()
            while not self._ending.is_set():
                began_s = time.monotonic()
                try:
                    self._turn(began_s)
                    problem = ""
                except (MessageError, OSError, StoreError) as error:
                    if problem != (problem := str(error)):
                        log.warning("cannot copy problem=%r", problem)
                    self._ending.wait(AGAIN_S)
                self._ending.wait(max(0.0, MOST_OFTEN_S - (time.monotonic() - began_s)))
        except SitegridError as error:
            self.ended = str(error)
        except Exception:  # a bug must end the process visibly
            log.critical("copying failed", exc_info=True)
            self.ended = "the follower has failed; its log says why"

    def _turn(self, began_s: float) -> None:
        """Ask for the next piece, and write it."""
        journal = self._journal
        row, event = (journal.last_row, journal.state().event) if journal else (0, 0)
        if (piece := self._ask(PieceOfJournal(row, event, WAIT_S))) is None:
            self._ending.wait(AGAIN_S)
            return
        if journal and self._went_another_course(journal, piece):
            self._discard()
            return
        if not self._journal:
            identity = StoreIdentity(piece.store, piece.descends)
            self._journal = self.location.open_copy(identity, self._site.name, self._site.frame)
        write(self._journal, piece, self._site)
        self._known = piece.last_row, began_s

    def _ask(self, query: PieceOfJournal) -> JournalPiece | None:
        selector = zenoh.Selector(keys.journal(self._site.name), selector_of(encode_journal_query(query)))
        for reply in self._session.get(selector, timeout=ANSWER_S):
            if reply.ok is not None:
                return decode_journal_piece(reply.ok.payload.to_bytes())
        return None

    def _went_another_course(self, journal: Journal, piece: JournalPiece) -> bool:
        """Whether the copy has what the server's journal has not; StoreError where it is of another store."""
        store = journal.identity().id
        if piece.store != store:
            problem = f"is a copy of store {store}, the site's map server has {piece.store}; choose another --copy"
            raise OtherStoreError(self.location, problem)
        ours = journal.state()
        return (
            piece.last_row < ours.row
            or piece.last_event < ours.event
            or is_other(piece.checksum, journal.row_checksum(ours.row))
            or is_other(piece.event_checksum, journal.event_checksum(ours.event))
        )

    def _discard(self) -> None:
        """Begin anew: the server's journal was restored from a backup, or the copy itself has lost its end."""
        log.warning("rows are gone: the copy is made anew folder=%s", self._folder)
        if self._journal:
            self._journal.close()
            self._journal = None
        snapshot.remove_beyond(self._folder, 0)
        checkpoints.remove_beyond(self._folder, 0)
        for path in self._folder.glob("journal.db*"):
            path.unlink(missing_ok=True)


class OtherStoreError(SitegridError):
    """The copy is of another store than the server's."""

    def __init__(self, where: object, problem: str) -> None:
        super().__init__(f"{where}: {problem}")


def write(journal: Journal, piece: JournalPiece, site: SiteConfig) -> None:
    """Write the rows of a piece in one commit, then its events; MessageError where a row is not what was asked for."""
    batches = decode_batches([row.batch for row in piece.rows], site.extent_m)
    try:
        journal.begin()
        for row, batch in zip(piece.rows, batches, strict=True):
            if isinstance(batch, MessageError):
                raise batch
            if row.row != journal.last_row + 1:
                raise StoreError(journal.where, f"row {row.row} does not follow row {journal.last_row}")
            lost = max(0, batch.first_seq - 1 - journal.watermark(batch.machine, batch.spool_id).seq)
            journal.append(Admission(batch, 0, lost), row.received_ns)
        journal.commit()
    except (MessageError, StoreError):
        journal.rollback()
        raise
    known = journal.state().event
    events = [(event.kind, event.stamp_ns, event.body) for event in piece.events if event.id > known]
    if events:
        journal.append_events(events)
