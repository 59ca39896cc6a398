"""Delivery rules, first in first out and at least once: a state machine without I/O, clock or threads.

Each event returns the next action; the caller performs it and reports the result:

    start_exchange -> ReadHead -> on_head -> Send -> on_reply -> Delete ... -> on_stored -> Wait -> start_exchange

It survives kills of router, server and agent: a reply follows the commit, and deletion the reply. An empty reply means
"no server" or "denied", never "done".
"""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.arrays import Table
from protocol.errors import Refusal
from protocol.machine.samples import empty
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch

# The set-up is at fault, not a sample: a person has to fix it, nothing is quarantined.
BLOCKING = {
    Refusal.WRONG_FRAME,
    Refusal.WRONG_MACHINE,
    Refusal.VERSION,
    Refusal.WALL_CLOCK,
    Refusal.SERVER_CLOCK,
    Refusal.OTHER_STORE,
    Refusal.UNSIGNED,
    Refusal.NOT_MSGPACK,
    Refusal.MISSING_FIELD,
    Refusal.WRONG_TYPE,
    Refusal.COLUMN_LENGTH,
}
PASSING = {Refusal.OVERLOADED, Refusal.STORE, Refusal.NOT_WRITER}  # the server will accept this batch later
SHARE = 1 / 3  # target share of the timeout per exchange: a link that becomes twice as slow still answers in time
IDLE_S = 0.5  # longest pause without samples


@dataclass(frozen=True)
class UplinkConfig:
    """timeout_s: deadline of an acknowledgement; exchanges aim at a third of it."""

    timeout_s: float = 3.0

    def __post_init__(self) -> None:
        if not 0 < self.timeout_s < math.inf:
            raise ValueError("timeout_s: must be positive and finite")


@dataclass(frozen=True)
class Pacing:
    """Batch sizes and pauses.

    first_batch: samples at first; halved on a timeout, doubled while exchanges are short. max_batch: a tenth of the
    server's limit. backoff_s, max_backoff_s: pause after a failure, doubled each time, randomised so that a fleet does
    not return to a restarted server at once. gather_s: pause once all is sent, as a batch costs the server a row and a
    sync.
    """

    first_batch: int = 200
    max_batch: int = 5000
    backoff_s: float = 0.2
    max_backoff_s: float = 5.0
    gather_s: float = 1.0


@dataclass(frozen=True)
class Head:
    """Oldest final samples of one run; without rows, an earlier run to close.

    lost_before: samples directly before them that will never be sent. newest: last seq of the current run; None for an
    earlier run. store: id of the store that the run is bound to, or empty.
    """

    spool_id: int
    first_seq: int
    rows: Table
    lost_before: int
    newest: int | None = None
    store: str = ""

    @property
    def acknowledged(self) -> int:
        """Last acknowledged seq before the rows."""
        return self.first_seq - 1 - self.lost_before


@dataclass(frozen=True)
class ReadHead:
    """Read up to `limit` samples of the spool's head; the result goes to `on_head`."""

    limit: int


@dataclass(frozen=True)
class Send:
    """Send a batch; the reply goes to `on_reply`."""

    payload: bytes


@dataclass(frozen=True)
class Delete:
    """Delete samples of a run up to a seq: this store has them on disk."""

    spool_id: int
    watermark: int
    store: str = ""


@dataclass(frozen=True)
class LowerWatermark:
    """Lower a run's watermark: the server was restored from a backup."""

    spool_id: int
    watermark: int


@dataclass(frozen=True)
class DeclareAgain:
    """Close all earlier runs again: the server lost rows of unknown runs."""


@dataclass(frozen=True)
class StartNewRun:
    """Renumber unacknowledged samples: another agent sends under this identity."""


@dataclass(frozen=True)
class Quarantine:
    """Set aside samples that the server refuses for good."""

    head: Head
    problem: str


@dataclass(frozen=True)
class Wait:
    """Pause, then call `start_exchange`. for_samples: new samples end the pause."""

    seconds: float
    for_samples: bool = False


SpoolAction = Delete | LowerWatermark | DeclareAgain | StartNewRun | Quarantine  # `on_stored` follows
Action = ReadHead | Send | SpoolAction | Wait


class Uplink:
    """Delivery of one machine's samples.

    held: why sending is suspended, or empty. problem: what keeps samples from the server now. stuck: the same, if only
    a person can fix it. ack_s_max: longest time from the first send of a batch to its acknowledgement. offer: latest
    offered calibration, or None.
    """

    def __init__(
        self,
        machine: str,
        frame: str,
        timeout_s: float,
        pacing: Pacing | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.machine = machine
        self.timeout_s = timeout_s
        self.counters: Counter[str] = Counter()
        self.problem = self.stuck = self.held = ""
        self.ack_s_max = 0.0
        self.offer: Any = None
        self._frame = frame
        self._pacing = pacing or Pacing()
        self._rng = rng or np.random.default_rng()
        self._limit = self._pacing.first_batch
        self._has_met_server = False
        self._failures = 0
        self._head: Head | None = None  # of the current batch
        self._took_s = 0.0
        self._unacknowledged_s = 0.0  # since the first send without acknowledgement
        self._newest_row = ("", 0)  # store, and its last row named
        self._declares = False

    def start_exchange(self) -> ReadHead | Wait:
        """Start an exchange, first and after each pause."""
        return Wait(IDLE_S, for_samples=True) if self.held else ReadHead(self._limit)

    def on_head(self, head: Head | None, spool_id: int) -> Send | Wait:
        """Send the spool's head (None: empty). spool_id: of the current run.

        Without samples the first batch is empty: it shows before driving whether the server accepts this machine.
        """
        self._head = head
        if head is None and self._has_met_server:
            return Wait(IDLE_S, for_samples=True)
        head = head or Head(spool_id, 1, empty(), 0)
        sent = (head.spool_id, head.first_seq, head.rows, self._frame, head.lost_before, head.store)
        return Send(encode_batch(SampleBatch(self.machine, *sent)))

    def on_reply(self, reply: Ack | Refused | None, took_s: float) -> SpoolAction | Wait:
        """Handle the last batch's reply (None: silence)."""
        self._took_s = took_s
        self._unacknowledged_s += took_s
        if reply is None:
            return self._on_silence()
        return self._on_refused(reply) if isinstance(reply, Refused) else self._on_ack(reply)

    def on_stored(self, action: SpoolAction) -> SpoolAction | Wait:
        """Finish the exchange: the spool has performed the action."""
        if isinstance(action, LowerWatermark | DeclareAgain | Quarantine):
            return Wait(0.0)
        pause_s = 0.0
        if isinstance(action, Delete) and self._head and (n := len(self._head.rows)):
            has_sent_all = n < self._limit and self._head.newest is not None
            pause_s = self._pacing.gather_s if has_sent_all else 0.0
            self._adapt(n)
        wait = self._succeed(pause_s)
        if not self._declares:
            return wait
        self._declares = False
        self.counters["declared_again"] += 1
        return DeclareAgain()

    def on_disk_error(self, error: Exception) -> Wait:
        """Back off: the spool could not be read or written."""
        self.counters["disk_errors"] += 1
        self.problem = str(error)
        return self._back_off()

    def on_bug(self, error: Exception) -> Wait:
        """Back off after an unforeseen exception."""
        self.counters["bugs"] += 1
        self.problem = f"the uplink failed: {error!r}; its log has more"
        return self._back_off()

    def _on_silence(self) -> Wait:
        """Immediate without a server; a link too slow for the batch uses up the timeout."""
        if self._took_s < self.timeout_s / 2:
            self.counters["unanswered"] += 1
            self.problem = "no map server answers; is one running, and does the router let this machine write?"
            return self._back_off()
        self.counters["timeouts"] += 1
        self.problem = f"no answer from the map server within {self.timeout_s:g} s"
        if self._head and len(self._head.rows):
            self._limit = max(1, len(self._head.rows) // 2)
        return self._back_off()

    def _on_ack(self, ack: Ack) -> SpoolAction | Wait:
        head, waited_s, self._unacknowledged_s = self._head, self._unacknowledged_s, 0.0
        if head is None:
            return self._succeed(0.0)
        if head.store and head.store not in (ack.store, ack.replaces):  # samples deleted on another store's word
            self.counters["other_store"] += 1
            self.problem = f"store {ack.store} acknowledges samples whose predecessors are in store {head.store}"
            self.stuck = self.problem
            return self._back_off()
        self._compare_row(ack, head)
        self.offer = self.offer if ack.offer is None else ack.offer
        if not len(head.rows):  # close an earlier run, even if the server's store is older
            return Delete(head.spool_id, max(ack.watermark, head.first_seq - 1), ack.store)
        if head.newest is not None and ack.watermark > head.newest:
            # Only a machine copied or set back while running, memory included, gives a number twice.
            self.counters["new_spool_ids"] += 1
            return StartNewRun()
        if ack.watermark < head.first_seq:
            self.problem = f"the map server acknowledges {ack.watermark}, which is not what was sent"
            return self._back_off()
        self.counters["batches"] += 1
        self.ack_s_max = max(self.ack_s_max, waited_s)
        return Delete(head.spool_id, ack.watermark, ack.store)

    def _compare_row(self, ack: Ack, head: Head) -> None:
        """Detect lost journal rows: a row number that falls or repeats.

        The server asks for this run's losses itself; only this agent knows those of earlier runs.
        """
        store, row = self._newest_row
        is_new = len(head.rows) > ack.trimmed
        self._declares = self._declares or (ack.store == store and (ack.row < row or (is_new and ack.row == row)))
        self._newest_row = (ack.store, ack.row)

    def _on_refused(self, refused: Refused) -> SpoolAction | Wait:
        head = self._head
        self.counters[f"refused_{refused.reason}"] += 1
        self.problem = refused.problem
        self.stuck = refused.problem if refused.reason in BLOCKING else ""
        if refused.reason in PASSING and refused.retry_after_s > 0:
            pause_s = min(refused.retry_after_s, self._pacing.max_backoff_s)
            return Wait(float(pause_s * self._rng.uniform(1.0, 1.5)))  # no sooner, and spread over the fleet
        if refused.reason in PASSING or refused.reason in BLOCKING or head is None or not len(head.rows):
            return self._back_off()
        if refused.reason == Refusal.GAP:
            if not 1 <= refused.expected <= head.acknowledged:
                return self._back_off()
            self.counters["lowered_watermarks"] += 1
            return LowerWatermark(head.spool_id, refused.expected - 1)
        if len(head.rows) > 1:  # bisect for the bad sample
            self._limit = len(head.rows) // 2
            return Wait(0.0)
        return Quarantine(head, refused.problem)

    def _succeed(self, pause_s: float) -> Wait:
        self.problem, self.stuck, self._failures, self._has_met_server = "", "", 0, True
        return Wait(pause_s)

    def _adapt(self, n: int) -> None:
        """Fit the batch size to the link by the duration of an exchange of n samples."""
        target_s, first = SHARE * self.timeout_s, self._pacing.first_batch
        if self._took_s > target_s and n > first:  # below `first` only by timeouts: a delay may be the link's own
            self._limit = max(first, int(n * target_s / self._took_s))
        elif self._took_s <= target_s / 2:
            self._limit = min(max(self._limit, 2 * n), self._pacing.max_batch)
        elif n < first and self._took_s < self.timeout_s / 2:
            self._limit = max(self._limit, n + 1 + n // 4)

    def _back_off(self) -> Wait:
        self._failures += 1
        pause_s = min(self._pacing.backoff_s * 2 ** min(self._failures - 1, 10), self._pacing.max_backoff_s)
        pause_s = float(pause_s * self._rng.uniform(0.5, 1.0))
        self._unacknowledged_s += pause_s
        return Wait(pause_s)
