"""The uplink: spool to server, first in first out, at least once. A state machine without I/O, and a thread around it.

EVIDENCE: what held through router, server and agent kills is query with payload, reply after the commit, watermark,
delete. An empty reply means "no server" or "denied", never "done".
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from agents.spool import Head, Spool
from protocol import keys
from protocol.arrays import Table
from protocol.codec import decode_reply, encode_batch
from protocol.errors import MessageError, Refusal
from protocol.messages import Ack, Refused, SampleBatch
from protocol.samples import empty

log = logging.getLogger("agents.uplink")

# The fault lies with the set-up, not with a sample: nothing is put aside, a person has to mend it.
BLOCKING = {
    Refusal.WRONG_FRAME,
    Refusal.WRONG_MACHINE,
    Refusal.VERSION,
    Refusal.WALL_CLOCK,
    Refusal.NOT_MSGPACK,
    Refusal.MISSING_FIELD,
    Refusal.WRONG_TYPE,
    Refusal.COLUMN_LENGTH,
}
PASSING = {Refusal.OVERLOADED, Refusal.STORE}  # the server will take the same batch later


@dataclass(frozen=True)
class UplinkConfig:
    """How samples are sent.

    batch_samples, max_batch_samples: how many at first and at most; halved on a time-out, doubled on success.
    timeout_s: how long to wait for an acknowledgement. backoff_s, max_backoff_s: pause after a failure, doubled each
    time.
    """

    batch_samples: int = 200
    max_batch_samples: int = 5000
    timeout_s: float = 3.0
    backoff_s: float = 0.2
    max_backoff_s: float = 5.0

    def __post_init__(self) -> None:
        if not 1 <= self.batch_samples <= self.max_batch_samples <= 20_000:
            raise ValueError("batch_samples must lie between 1 and max_batch_samples, that at most 20000")
        if min(self.timeout_s, self.backoff_s) <= 0 or self.max_backoff_s < self.backoff_s:
            raise ValueError("timeout_s and backoff_s must be positive, max_backoff_s not below backoff_s")


class UplinkState:
    """Decides what to send and what an answer means; no clock, no network."""

    def __init__(self, machine: str, frame: str, spool: Spool, config: UplinkConfig) -> None:
        self.counters: Counter[str] = Counter()
        self.problem = ""
        self._machine = machine
        self._frame = frame
        self._spool = spool
        self._config = config
        self._limit = config.batch_samples
        self._has_met = False
        self._failures = 0
        self._head: Head | None = None

    def next_payload(self) -> bytes | None:
        """Bytes of the next batch, None if there is nothing to send. The first one asks for the watermark."""
        self._head = self._spool.head(self._limit) if self._has_met else None
        if self._has_met and self._head is None:
            return None
        head = self._head
        if head is None:
            return self._encode(self._spool.spool_id, 1, empty(), 0)
        return self._encode(head.spool_id, head.first_seq, head.rows, head.lost_before)

    def on_reply(self, reply: Ack | Refused | None) -> float:
        """Take in the answer to the last payload, None for none; returns the pause before the next [s]."""
        if reply is None:
            self.counters["timeouts"] += 1
            self.problem = "no answer from the map server"
            self._limit = max(1, self._limit // 2)
            return self._back_off()
        if isinstance(reply, Refused):
            return self._on_refused(reply)
        self._on_ack(reply)
        self.problem, self._failures = "", 0
        return 0.0

    def on_disk_error(self, error: Exception) -> float:
        """Take in that the spool could not be read or written; returns the pause before the next try [s]."""
        self.counters["disk_errors"] += 1
        self.problem = f"the spool cannot be used: {error}; look at the machine's disk"
        return self._back_off()

    def _encode(self, spool_id: int, first_seq: int, rows: Table, lost_before: int) -> bytes:
        return encode_batch(SampleBatch(self._machine, spool_id, first_seq, rows, self._frame, lost_before))

    def _on_ack(self, ack: Ack) -> None:
        if self._has_met:
            self.counters["batches"] += 1
            self._spool.acknowledge(ack.watermark)
            self._limit = min(self._limit * 2, self._config.max_batch_samples)
        else:
            self._has_met = True
            self.counters["new_spool_ids"] += self._spool.meet(ack.watermark)

    def _on_refused(self, refused: Refused) -> float:
        self.counters[f"refused_{refused.reason}"] += 1
        self.problem = refused.problem
        if refused.reason in PASSING or refused.reason in BLOCKING:
            return self._back_off()
        if self._head is None:
            return self._back_off()
        if refused.reason == Refusal.GAP:
            if not 1 <= refused.expected <= self._head.first_seq:
                return self._back_off()
            # The server knows less than it once acknowledged (restored from a backup): what it lost is declared lost.
            self._spool.acknowledge(refused.expected - 1)
            return 0.0
        if len(self._head.rows) > 1:  # find the sample that is to blame
            self._limit = len(self._head.rows) // 2
            return 0.0
        self._spool.put_aside(self._head, refused.problem)
        log.error("put aside seq=%d problem=%r", self._head.first_seq, refused.problem)
        return 0.0

    def _back_off(self) -> float:
        self._failures += 1
        pause_s: float = self._config.backoff_s * 2 ** min(self._failures - 1, 10)
        return min(pause_s, self._config.max_backoff_s)


class Uplink:
    """Runs an UplinkState over Zenoh on a thread of its own."""

    def __init__(self, session: zenoh.Session, site: str, machine: str, state: UplinkState, timeout_s: float) -> None:
        self.state = state
        self._session = session
        self._key = keys.ingest(site, machine)
        self._timeout_s = timeout_s
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Say that there is something new to send."""
        self._wake.set()

    def close(self) -> None:
        """Stop after the exchange that is under way."""
        self._stop.set()
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            try:
                payload = self.state.next_payload()
                pause_s = self.state.on_reply(self._ask(payload)) if payload else None
            except sqlite3.Error as error:  # a full or failing disk: the samples wait, the agent goes on
                pause_s = self.state.on_disk_error(error)
            if pause_s is None:
                self._wake.wait(0.5)
            elif pause_s > 0:
                self._stop.wait(pause_s)

    def _ask(self, payload: bytes) -> Ack | Refused | None:
        try:
            for reply in self._session.get(self._key, payload=payload, timeout=self._timeout_s):
                if reply.ok is not None:
                    return decode_reply(reply.ok.payload.to_bytes())
        except (zenoh.ZError, MessageError) as error:
            log.warning("no usable answer error=%r", str(error))
        return None


def linger(is_empty: Callable[[], bool], wait: Callable[[float], object], clock: Callable[[], float], s: float) -> bool:
    """Wait until the spool is empty, at most `s` seconds; returns whether it is."""
    end_s = clock() + s
    while not is_empty():
        if clock() >= end_s:
            return False
        wait(0.05)
    return True
