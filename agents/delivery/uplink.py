"""The rules of delivery, first in first out and at least once: a state machine without I/O, clock or threads.

Each event returns the next action; whoever carries it out (uplink_thread.py, or a test) reports the result as an event:

    start_exchange -> ReadHead -> on_head -> Send -> on_reply -> Delete ... -> on_stored -> Wait -> start_exchange

What holds through kills of router, server and agent is a query with payload, a reply after the commit, a watermark, and
a deletion after the reply. An empty reply means "no server" or "denied", never "done".
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

# The fault lies with the set-up, not with a sample: nothing is quarantined, a person has to mend it.
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
PASSING = {Refusal.OVERLOADED, Refusal.STORE, Refusal.NOT_WRITER}  # the server will accept the same batch later
SHARE = 1 / 3  # of the time-out that an exchange should take: a link that gets twice as slow still answers in time
IDLE_S = 0.5  # longest pause without samples


@dataclass(frozen=True)
class UplinkConfig:
    """timeout_s: how long to wait for an acknowledgement; an exchange is kept to about a third of it."""

    timeout_s: float = 3.0

    def __post_init__(self) -> None:
        if not 0 < self.timeout_s < math.inf:
            raise ValueError("timeout_s: must be positive and finite")


@dataclass(frozen=True)
class Pacing:
    """Size of batches and length of pauses.

    first_batch: samples in a batch at first; halved on a time-out, doubled while exchanges stay short. max_batch: a
    tenth of what a server accepts. backoff_s, max_backoff_s: pause after a failure, doubled each time, of which half to
    all is used at random: a fleet must not return to a restarted server all at once. gather_s: pause after a batch that
    left nothing behind, in which samples gather: each batch costs the server a journal row and a sync.
    """

    first_batch: int = 200
    max_batch: int = 5000
    backoff_s: float = 0.2
    max_backoff_s: float = 5.0
    gather_s: float = 1.0


@dataclass(frozen=True)
class Head:
    """What the spool hands over: its oldest final samples, of one run; none where an earlier run is to be closed.

    lost_before: how many directly before them will never be sent. newest: the last sequence number given out, of the
    run that is being recorded; None for an earlier run. store: id of the store that the run is bound to, empty before
    one has acknowledged a sample of it.
    """

    spool_id: int
    first_seq: int
    rows: Table
    lost_before: int
    newest: int | None = None
    store: str = ""

    @property
    def acknowledged(self) -> int:
        """The last sample before the rows that the server has confirmed."""
        return self.first_seq - 1 - self.lost_before


@dataclass(frozen=True)
class ReadHead:
    """Read the head of the spool, at most so many samples; the result goes to `on_head`."""

    limit: int


@dataclass(frozen=True)
class Send:
    """Send a batch; the reply goes to `on_reply`."""

    payload: bytes


@dataclass(frozen=True)
class Delete:
    """Delete the samples of a run up to a sequence number: the server has them on disk, in this store."""

    spool_id: int
    watermark: int
    store: str = ""


@dataclass(frozen=True)
class LowerWatermark:
    """Remember that the server knows less of a run than it acknowledged: it was restored from a backup."""

    spool_id: int
    watermark: int


@dataclass(frozen=True)
class DeclareAgain:
    """Close all earlier runs once more: the server has lost journal rows, and does not know of which runs."""


@dataclass(frozen=True)
class StartNewRun:
    """Give what is not acknowledged of the present run a new identity: another agent sends under the present one."""


@dataclass(frozen=True)
class Quarantine:
    """Keep samples that the server will never accept out of the way, for a person to look at."""

    head: Head
    problem: str


@dataclass(frozen=True)
class Wait:
    """Pause, then call `start_exchange`. for_samples: new samples end the pause."""

    seconds: float
    for_samples: bool = False


SpoolAction = Delete | LowerWatermark | DeclareAgain | StartNewRun | Quarantine  # when done, `on_stored` is called
Action = ReadHead | Send | SpoolAction | Wait


class Uplink:
    """Delivery of one machine's samples.

    held: why nothing is sent although it could be, empty if it is. problem: what keeps samples from the server now;
    stuck: the same, where only a person can mend it. ack_s_max: the longest time from the first sending of a batch
    until samples of it were acknowledged. offer: the last that came for the machine's calibration, None for none.
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
        self._head: Head | None = None  # of the batch under way
        self._took_s = 0.0  # by its exchange
        self._unacknowledged_s = 0.0  # since samples were sent that no acknowledgement has answered
        self._newest_row = ("", 0)  # store, and the last row that it has named
        self._declares = False  # all runs again, once the present exchange is done

    def start_exchange(self) -> ReadHead | Wait:
        """Begin: at the start, and after each pause."""
        return Wait(IDLE_S, for_samples=True) if self.held else ReadHead(self._limit)

    def on_head(self, head: Head | None, spool_id: int) -> Send | Wait:
        """Send the head of the spool; None if it has none. spool_id: of the run that is being recorded.

        Without samples the first batch is empty: whether the server accepts this machine is known before it has driven.
        """
        self._head = head
        if head is None and self._has_met_server:
            return Wait(IDLE_S, for_samples=True)
        head = head or Head(spool_id, 1, empty(), 0)
        sent = (head.spool_id, head.first_seq, head.rows, self._frame, head.lost_before, head.store)
        return Send(encode_batch(SampleBatch(self.machine, *sent)))

    def on_reply(self, reply: Ack | Refused | None, took_s: float) -> SpoolAction | Wait:
        """Act on the reply to the last batch, None for none. took_s: how long the exchange took."""
        self._took_s = took_s
        self._unacknowledged_s += took_s
        if reply is None:
            return self._on_silence()
        return self._on_refused(reply) if isinstance(reply, Refused) else self._on_ack(reply)

    def on_stored(self, action: SpoolAction) -> SpoolAction | Wait:
        """End the exchange: the spool has done what was asked of it."""
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
        """The spool could not be read or written."""
        self.counters["disk_errors"] += 1
        self.problem = str(error)
        return self._back_off()

    def on_bug(self, error: Exception) -> Wait:
        """An action failed in a way that was not foreseen."""
        self.counters["bugs"] += 1
        self.problem = f"the uplink failed: {error!r}; its log has more"
        return self._back_off()

    def _on_silence(self) -> Wait:
        """No reply. It comes at once where there is no server; a link too slow for the batch uses up the time-out."""
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
        if head.store and head.store not in (ack.store, ack.replaces):  # what it deleted on that one's word is not here
            self.counters["other_store"] += 1
            self.problem = f"store {ack.store} acknowledges samples whose predecessors are in store {head.store}"
            self.stuck = self.problem
            return self._back_off()
        self._compare_row(ack, head)
        self.offer = self.offer if ack.offer is None else ack.offer
        if not len(head.rows):  # an earlier run is closed, even if the server is older than the run
            return Delete(head.spool_id, max(ack.watermark, head.first_seq - 1), ack.store)
        if head.newest is not None and ack.watermark > head.newest:
            # Only a machine that was copied or set back while it ran, memory and all, gives a number twice.
            self.counters["new_spool_ids"] += 1
            return StartNewRun()
        if ack.watermark < head.first_seq:
            self.problem = f"the map server acknowledges {ack.watermark}, which is not what was sent"
            return self._back_off()
        self.counters["batches"] += 1
        self.ack_s_max = max(self.ack_s_max, waited_s)
        return Delete(head.spool_id, ack.watermark, ack.store)

    def _compare_row(self, ack: Ack, head: Head) -> None:
        """See whether the journal has lost rows: it goes on behind one that it has named, or gives its number again.

        What it lost of this run it will ask for itself. Of earlier runs only this agent knows.
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
            return Wait(float(pause_s * self._rng.uniform(1.0, 1.5)))  # no sooner, and not all machines at once
        if refused.reason in PASSING or refused.reason in BLOCKING or head is None or not len(head.rows):
            return self._back_off()
        if refused.reason == Refusal.GAP:
            if not 1 <= refused.expected <= head.acknowledged:
                return self._back_off()
            self.counters["lowered_watermarks"] += 1
            return LowerWatermark(head.spool_id, refused.expected - 1)
        if len(head.rows) > 1:  # find the sample that is to blame
            self._limit = len(head.rows) // 2
            return Wait(0.0)
        return Quarantine(head, refused.problem)

    def _succeed(self, pause_s: float) -> Wait:
        self.problem, self.stuck, self._failures, self._has_met_server = "", "", 0, True
        return Wait(pause_s)

    def _adapt(self, n: int) -> None:
        """Fit the size of a batch to the link, by how long the exchange of n samples took."""
        target_s, first = SHARE * self.timeout_s, self._pacing.first_batch
        if self._took_s > target_s and n > first:  # only time-outs go below `first`: the delay may be the link's own
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
