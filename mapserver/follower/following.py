"""A thread that has a replica follow a journal; what others read of it, and how far behind it is.

A row that was folded may be gone when the journal is looked at again: a store that was restored, a database that failed
over. It is noticed by the id of the store, by numbers and checksums of the last row (in journal or archive) and of the
last event, and by an epoch that is lower than before. Then the map is given up, and folded again. A replica of a
database that is behind another one has not lost anything.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from mapserver.config import ServerConfig
from mapserver.follower.replica import Replica
from mapserver.ingest.merge_waits import MergeWaits
from mapserver.journal.facts import Facts
from mapserver.journal.history import History, fold_history, read_history, release_memory
from mapserver.journal.journal import JournalReader, JournalState
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Selection
from mapserver.past.past import FoldedAnew, StorePast, fold_anew
from protocol.errors import QueryError, Refusal, StoreError
from protocol.site.site_config import SiteConfig

ASK_S = 1.0  # a notification may be lost: the journal is asked so often all the same
OPEN_S = 2.0  # a connection lasts so long: another file may have taken the place of the one that it reads
RETRY_S = 1.0
T = TypeVar("T")
log = logging.getLogger("mapserver.follower.following")


class UnfitError(StoreError):
    """A journal of another site or frame."""


class Following:
    """A replica and its thread. All but the thread itself is for any thread.

    waits: who waits for a row. past: what maps of the past are read from. ended: why it has given up, empty while it
    goes on; the process should end.
    """

    def __init__(self, location: JournalLocation, site: SiteConfig, config: ServerConfig) -> None:
        self.location, self.site, self.config = location, site, config
        self.waits = MergeWaits(0)
        self.past = self._new_past()
        self.ended = ""
        self._lock = threading.Lock()  # of the replica: held while pages are taken from it, or rows are folded
        self._replica: Replica | None = None
        self._epoch = 0  # the newest one that was seen
        self._compared: object = None  # where the last row was in the archive when it was compared
        self._journalled, self._complete_s = 0, float("-inf")
        self._problem = ""
        self._anew: tuple[Facts, Future[FoldedAnew | None]] | None = None
        self._folds = ThreadPoolExecutor(1, thread_name_prefix="refold")
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="following", daemon=True)

    def start(self) -> None:
        """Follow from now on."""
        self._thread.start()

    def read_once(self) -> None:
        """Read what is there now, on the caller's thread, in place of following it; StoreError where that fails."""
        with self.location.reader() as reader:
            self._require_fit(reader)
            complete_s = reader.complete_s()
            self._look(reader, reader.state(), complete_s)

    def run(self, work: Callable[[Replica], T]) -> T:
        """Have `work` done with the replica as it is; QueryError where there is none."""
        with self._lock:
            if self._replica is None:
                raise QueryError(Refusal.NOT_HERE, "this follower has no map yet; ask the map server")
            return work(self._replica)

    def behind(self) -> tuple[int, float]:
        """How many rows the map lacks, and how long ago it had all that was journalled [s]; infinite for never."""
        replica = self._replica
        rows = max(0, self._journalled - (replica.merged if replica else 0))
        return rows, time.monotonic() - self._complete_s if replica else float("inf")

    @property
    def journalled(self) -> int:
        """The last row of the journal, as of the last look."""
        return self._journalled

    def stop(self) -> None:
        """Have the thread end soon."""
        self._ending.set()

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        self._folds.shutdown()
        self.waits.close()

    def _run(self) -> None:
        while not (self._ending.is_set() or self.ended):
            try:
                self._read_for_a_while()
            except UnfitError as error:
                self.ended = str(error)
            except (StoreError, OSError) as error:
                self._name(str(error))
                self._ending.wait(RETRY_S)
            except Exception:  # a bug must end the process visibly: a map that stands still is worse than none
                log.critical("following failed", exc_info=True)
                self.ended = "the follower has failed; its log says why"

    def _name(self, problem: str) -> None:
        """Log a problem once, until there is another one or none."""
        if problem and problem != self._problem:
            log.warning("cannot follow problem=%r", problem)
        self._problem = problem

    def _read_for_a_while(self) -> None:
        if not self.location.exists():
            raise StoreError(self.location, "is not there yet; it is looked for every second")
        end_s = time.monotonic() + OPEN_S
        with self.location.reader() as reader:
            self._require_fit(reader)
            while time.monotonic() < end_s and not self._ending.is_set():
                complete_s = reader.complete_s()  # asked first: the state is of then, or newer
                state = reader.state()
                self._look(reader, state, complete_s)
                self._name("")
                reader.follow(state, ASK_S)

    def _require_fit(self, reader: JournalReader) -> None:
        if (reader.site, reader.frame) != (self.site.name, self.site.frame):
            theirs, ours = f"site {reader.site!r}, frame {reader.frame}", f"{self.site.name!r}, {self.site.frame}"
            raise UnfitError(reader.where, f"is of {theirs}; this follower has {ours}: compare the site files")

    def _look(self, reader: JournalReader, state: JournalState, complete_s: float) -> None:
        """Read what is new. complete_s: see `JournalReader`."""
        replica = self._replica
        if replica and self._lags(reader, state, replica):
            return
        self._journalled = state.row
        if replica is None or self._is_gone(reader, state, replica):
            replica = self._begin(reader, state)
        if replica is None:
            return
        with self._lock:
            _hear(replica, reader)
        self._fold(reader, replica, state.row)
        self._correct(reader, replica)
        if replica.merged >= state.row:
            self._complete_s = max(self._complete_s, complete_s)
        self.waits.advance(replica.merged)

    def _lags(self, reader: JournalReader, state: JournalState, replica: Replica) -> bool:
        """Whether the journal is read from a replica of the database that is behind another one, read before.

        Where rows are gone for good, the server that goes on has a higher epoch.
        """
        lacks = state.row < replica.merged or state.event < replica.event or state.epoch < self._epoch
        return lacks and reader.is_replica and state.epoch <= self._epoch and reader.identity().id == replica.store

    def _is_gone(self, reader: JournalReader, state: JournalState, replica: Replica) -> bool:
        """Whether the journal lacks what was read of it."""
        is_gone = (
            reader.identity().id != replica.store
            or state.row < replica.merged
            or state.event < replica.event
            or _is_other(reader.event_checksum(replica.event), replica.event_checksum)
            or state.epoch < self._epoch
            or self._is_another_row(reader, replica)
        )
        self._epoch = state.epoch
        if is_gone:
            log.warning("rows are gone: the map is folded again journal=%s row=%d", reader.where, replica.merged)
        return is_gone

    def _is_another_row(self, reader: JournalReader, replica: Replica) -> bool:
        """Whether the last row that was folded is not the one that is there."""
        checksum = reader.row_checksum(replica.merged)
        if checksum is None and replica.checksum is not None:
            checksum = self._archived_checksum(reader, replica.merged)
        return _is_other(checksum, replica.checksum)

    def _archived_checksum(self, reader: JournalReader, row: int) -> int | None:
        """Of a row in the archive, which is read once; None where nothing new can be said."""
        archive = self.location.archive  # with no file open: another one may have taken the place of one
        try:
            (file,) = archive.cover(row, row - 1)
            stat = file.stat()
            if (seen := (row, file, stat.st_ino, stat.st_mtime_ns)) == self._compared:
                return None
            checksum, self._compared = History(reader, archive).row_checksum(row), seen
        except (StoreError, OSError):  # who needs the file says so
            return None
        return checksum

    def _begin(self, reader: JournalReader, state: JournalState) -> Replica | None:
        """Fold the map from the newest snapshot or checkpoint that is true, without answering meanwhile.

        None where it is to end.
        """
        with self._lock:
            self._replica = None
        self._complete_s, self._anew, self._epoch = float("-inf"), None, state.epoch
        self.past = self._new_past()  # its index is of rows
        self.waits.advance(0)
        replica = Replica(self.site, self.config, reader.identity().id)
        _hear(replica, reader)
        facts = replica.wanted
        folded = fold_anew(self.past, reader, facts, self._ending.is_set)
        last = reader.last_row
        history, selection = History(reader, self.past.archive), Selection.by(facts)
        if not folded or not fold_history(folded.grid, history, folded.row, last, selection, self._ending.is_set):
            return None
        release_memory()
        replica.adopt(folded.grid, last, facts)
        replica.checksum = history.row_checksum(last)
        # The site's now is that of the rows in the map: watermarks are of these, and of some that are folded next.
        replica.reach((machine, mark.newest_ns) for (machine, _), mark in reader.watermarks().items())
        self._fold(reader, replica, reader.last_row)
        with self._lock:
            self._replica = replica
        log.info("map folded row=%d fact=%d", replica.merged, facts.number)
        return replica

    def _fold(self, reader: JournalReader, replica: Replica, until: int) -> None:
        if replica.merged >= until:
            return
        for rows in read_history(History(reader, self.past.archive), replica.merged, until):
            with self._lock:
                replica.fold(rows)
            if replica is self._replica:
                self.waits.advance(replica.merged)
            if self._ending.is_set():
                return

    def _correct(self, reader: JournalReader, replica: Replica) -> None:
        """Have the map follow decisions: another grid is folded beside it, and takes its place once it has its rows."""
        if self._anew is None:
            if replica.wanted != replica.facts:
                facts = replica.wanted
                self._anew = facts, self._folds.submit(self._fold_anew, facts)
            return
        facts, future = self._anew
        if not future.done():
            return
        self._anew = None  # one that failed is done again
        folded = future.result()
        if folded and folded.row > replica.merged:
            self._anew = facts, future  # the rows of this one come first
            return
        if folded is None or facts.number <= replica.facts.number:  # a decision was taken back meanwhile
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


def _is_other(there: int | None, known: int | None) -> bool:
    """Whether two checksums of one number are known, and differ: the journal went another course."""
    return None not in (there, known) and there != known


def _hear(replica: Replica, reader: JournalReader) -> None:
    replica.hear(reader.events(after=replica.event), reader.where)
