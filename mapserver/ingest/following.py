"""A replica that follows a journal, on its own thread or by turns, and its readers.

If its rows vanish (`mapserver/journal/tail.py`), the map is dropped and folded again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from mapserver.config import ServerConfig
from mapserver.ingest.merge_waits import MergeWaits
from mapserver.ingest.replica import Replica
from mapserver.journal.facts import Facts
from mapserver.journal.history import History, fold_history, fold_samples, pieces, release_memory
from mapserver.journal.journal import JournalReader, JournalState
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Selection
from mapserver.journal.tail import Tail
from mapserver.past.past import FoldedAnew, StorePast, begun, fold_anew
from protocol.errors import QueryError, Refusal, StoreError
from protocol.site.site_config import SiteConfig

ASK_S = 1.0  # polling interval, because notifications may be lost
OPEN_S = 2.0  # lifetime of a connection, whose file may be replaced
PAUSE_S, MOST_PAUSE_S = 0.1, 5.0  # pause after unreadable rows; doubles, because reading up to them takes time
T = TypeVar("T")
log = logging.getLogger("mapserver.ingest.following")


class UnfitError(StoreError):
    """A journal of another site or frame."""


class Following:
    """A replica and its upkeep; thread-safe, except for turns.

    waits: for merged rows. past: source of past maps. ended: why it gave up, or "".
    """

    def __init__(self, location: JournalLocation, site: SiteConfig, config: ServerConfig) -> None:
        self.location, self.site, self.config = location, site, config
        self.waits = MergeWaits(0)
        self.past = self._new_past()
        self.ended = ""
        self._lock = threading.Lock()  # guards the replica while pages are taken or rows folded
        self._replica: Replica | None = None
        self._is_whole = False  # was complete once
        self._reader: JournalReader | None = None
        self._reopen_s = 0.0
        self._known = JournalState(0, 0, 0)
        self._complete_s = float("-inf")
        self._problem, self._again_s, self._pause_s = "", 0.0, PAUSE_S
        self._anew: tuple[Facts, Future[FoldedAnew | None]] | None = None
        self._folds = ThreadPoolExecutor(1, thread_name_prefix="refold")
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="following", daemon=True)

    def start(self) -> None:
        """Start following."""
        self._thread.start()

    def read_once(self) -> None:
        """Read once on the caller's thread, instead of following; StoreError if that fails."""
        reader = self._opened()
        complete_s = reader.complete_s()
        self._look(reader, reader.state(), complete_s)
        self._close_reader()

    def run(self, work: Callable[[Replica], T]) -> T:
        """Run `work` on the replica; QueryError without one."""
        with self._lock:
            if self._replica is None or not self._is_whole:
                raise QueryError(Refusal.NOT_HERE, "this follower has no map yet; ask the map server")
            return work(self._replica)

    def behind(self) -> tuple[int, float]:
        """Rows missing from the map, and seconds since none was (inf for never)."""
        replica = self._replica
        rows = max(0, self._known.row - (replica.merged if replica else 0))
        return rows, time.monotonic() - self._complete_s

    @property
    def journalled(self) -> int:
        """The journal's last row, at the last look."""
        return self._known.row

    def stop(self) -> None:
        """Ask the thread to end."""
        self._ending.set()

    def close(self) -> None:
        """End the thread, and close the reader."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        self._folds.shutdown()
        self.waits.close()
        self._close_reader()

    def turn(self, timeout_s: float) -> None:
        """Wait for news up to a timeout and apply it; log a problem once."""
        if (left_s := self._again_s - time.monotonic()) > 0:
            self._ending.wait(min(left_s, timeout_s))
            return
        try:
            reader = self._opened()
            reader.follow(self._known, timeout_s)
            complete_s = reader.complete_s()  # asked first, so the state is not older
            self._look(reader, reader.state(), complete_s)
            self._problem, self._pause_s = "", PAUSE_S
        except (StoreError, OSError) as error:  # the database is away, as during a promotion, or damaged
            if isinstance(error, UnfitError):
                self.ended = str(error)
            elif str(error) != self._problem:
                log.warning("cannot follow problem=%r", str(error))
            self._problem, self._again_s = str(error), time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, MOST_PAUSE_S)
            self._close_reader()

    def _run(self) -> None:
        while not (self._ending.is_set() or self.ended):
            try:
                self.turn(ASK_S)
            except Exception:  # a bug must end the process: a frozen map is worse than none
                log.critical("following failed", exc_info=True)
                self.ended = "the follower has failed; its log says why"

    def _opened(self) -> JournalReader:
        """The reader, reopened now and then; UnfitError for another site."""
        if time.monotonic() >= self._reopen_s:
            self._close_reader()
        if self._reader is None:
            if not self.location.exists():
                raise StoreError(self.location, "is not there yet; it is looked for again and again")
            self._reader, self._reopen_s = self.location.reader(), time.monotonic() + OPEN_S
            if (self._reader.site, self._reader.frame) != (self.site.name, self.site.frame):
                theirs = f"site {self._reader.site!r}, frame {self._reader.frame}"
                ours = f"{self.site.name!r}, {self.site.frame}: compare the site files"
                raise UnfitError(self._reader.where, f"is of {theirs}; this follower has {ours}")
        return self._reader

    def _close_reader(self) -> None:
        if self._reader:
            self._reader.close()
            self._reader = None

    def _look(self, reader: JournalReader, state: JournalState, complete_s: float) -> None:
        """Read what is new. complete_s: see `JournalReader`."""
        replica = self._replica
        if replica and replica.tail.lags(reader, state):
            return
        self._known = state
        if replica and replica.tail.is_gone(reader, state):
            log.warning("rows are gone: the map is folded again journal=%s row=%d", reader.where, replica.merged)
            self._forget()
        self._replica = replica = self._replica or self._begun(reader)
        self._hear(reader, replica)
        if not self._is_whole and replica.wanted != replica.facts:  # nobody uses it yet
            self._replica = replica = self._begun(reader)
        self._fold(reader, replica, state.row)
        self._correct(reader, replica)
        if replica.merged >= state.row:
            self._is_whole, self._complete_s = True, max(self._complete_s, complete_s)
        if self._is_whole:
            self.waits.advance(replica.merged)
        if problem := replica.tail.problem:
            raise problem

    def _forget(self) -> None:
        """Drop the map; queries fail until the next."""
        with self._lock:
            self._replica, self._is_whole = None, False
        self._complete_s, self._anew = float("-inf"), None
        self.past = self._new_past()  # its index is by rows
        self.waits.advance(0)

    def _begun(self, reader: JournalReader) -> Replica:
        """A replica from the newest valid checkpoint, or empty."""
        replica = Replica(self.site, self.config, Tail(reader, self.past.archive))
        self._hear(reader, replica)
        if made := begun(self.past, reader, replica.wanted, self._ending.is_set):
            grid, row = made
            replica.adopt(grid, row, replica.wanted)
            replica.tail.skip_to(reader, row)
        return replica

    def _hear(self, reader: JournalReader, replica: Replica) -> None:
        events = reader.events(after=replica.tail.event)
        with self._lock:
            replica.hear(events, reader.where)

    def _fold(self, reader: JournalReader, replica: Replica, until: int) -> None:
        if not self._is_whole:
            self._fold_long(reader, replica, until)
            return
        for rows in replica.tail.rows(reader, until):
            with self._lock:
                replica.fold(rows)
            self.waits.advance(replica.merged)
            if self._ending.is_set():
                return

    def _fold_long(self, reader: JournalReader, replica: Replica, until: int) -> None:
        """Fold all readable rows before answering."""
        facts = replica.facts
        rows = (some.without(facts.excluded) for some in replica.tail.rows(reader, until))
        if fold_samples(replica.grid, pieces(rows, Selection.by(facts)), self._ending.is_set):
            replica.adopt(replica.grid, replica.tail.row, facts)
            # The site's now is that of merged rows; watermarks include some that follow.
            replica.reach((machine, mark.newest_ns) for (machine, _), mark in reader.watermarks().items())
            release_memory()

    def _correct(self, reader: JournalReader, replica: Replica) -> None:
        """Follow decisions: fold another grid beside, and swap once it has all rows."""
        if self._anew is None:
            if replica.wanted != replica.facts:
                facts = replica.wanted
                self._anew = facts, self._folds.submit(self._fold_anew, facts)
            return
        facts, future = self._anew
        if not future.done():
            return
        self._anew = None  # retried after a failure
        folded = future.result()
        if folded and folded.row > replica.merged:
            self._anew = facts, future  # this grid's rows come first
            return
        if folded is None or facts.number <= replica.facts.number:  # the decision was withdrawn
            return
        history, selection = History(reader, self.past.archive), Selection.by(facts)
        if fold_history(folded.grid, history, folded.row, replica.merged, selection, self._ending.is_set, 1):
            with self._lock:
                replica.adopt(folded.grid, replica.merged, facts)
            log.info("map folded again fact=%d without=%s", facts.number, ",".join(sorted(facts.excluded)))
        release_memory()

    def _new_past(self) -> StorePast:
        return StorePast.of_store(self.location.folder, self.site.cell_m, self.config.fold, self.location.trusted_row)

    def _fold_anew(self, facts: Facts) -> FoldedAnew | None:
        with self.location.reader() as reader:
            return fold_anew(self.past, reader, facts, self._ending.is_set)
