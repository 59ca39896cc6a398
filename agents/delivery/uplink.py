"""The uplink: spool to server, first in first out, at least once. A state machine without I/O, and a thread around it.

EVIDENCE: what held through router, server and agent kills is query with payload, reply after the commit, watermark,
delete. An empty reply means "no server" or "denied", never "done".
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import zenoh

from agents.delivery.spool import Head, Spool
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import empty
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch

log = logging.getLogger("agents.delivery.uplink")

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
MAX_GATHER_S = 60.0  # samples lie on the machine's disk alone meanwhile
SHARE = 1 / 3  # of the time-out that an exchange should take: a link that gets twice as slow still answers in time


@dataclass(frozen=True)
class UplinkConfig:
    """How samples are sent.

    batch_samples, max_batch_samples: how many at first and at most; halved on a time-out, doubled while exchanges stay
    short. timeout_s: how long to wait for an acknowledgement; an exchange is kept to about a third of it. backoff_s,
    max_backoff_s: pause after a failure, doubled each time, of which half to all is taken at random. gather_s: pause
    after a batch that left nothing behind, in which samples gather: each batch costs the server a row and a sync.
    """

    batch_samples: int = 200
    max_batch_samples: int = 5000
    timeout_s: float = 3.0
    backoff_s: float = 0.2
    max_backoff_s: float = 5.0
    gather_s: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.batch_samples <= self.max_batch_samples <= 20_000:
            raise ValueError("batch_samples must lie between 1 and max_batch_samples, that at most 20000")
        if min(self.timeout_s, self.backoff_s) <= 0 or self.max_backoff_s < self.backoff_s:
            raise ValueError("timeout_s and backoff_s must be positive, max_backoff_s not below backoff_s")
        if not 0 <= self.gather_s <= MAX_GATHER_S:
            raise ValueError(f"gather_s must lie between 0 and {MAX_GATHER_S:g}")


class UplinkState:
    """Decides what to send and what an answer means; no clock, no network.

    held: why nothing is sent although it could be, empty if it is. rng: spreads retries, so that a fleet does not
    return to a restarted server all at once.
    """

    def __init__(
        self, machine: str, frame: str, spool: Spool, config: UplinkConfig, rng: np.random.Generator | None = None
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.problem = ""
        self.held = ""
        self._machine = machine
        self._frame = frame
        self._spool = spool
        self._config = config
        self._rng = rng or np.random.default_rng()
        self._limit = config.batch_samples
        self._has_met = False
        self._failures = 0
        self._head: Head | None = None

    def next_payload(self) -> bytes | None:
        """Bytes of the next batch, None if there is nothing to send.

        Without samples the first one is an empty batch: whether the server takes this machine is known before it has
        driven.
        """
        if self.held:
            return None
        self._head = self._spool.head(self._limit)
        if self._head is None and self._has_met:
            return None
        head = self._head or Head(self._spool.spool_id, 1, empty(), 0)
        return encode_batch(
            SampleBatch(self._machine, head.spool_id, head.first_seq, head.rows, self._frame, head.lost_before)
        )

    def on_reply(self, reply: Ack | Refused | None, took_s: float) -> float:
        """Take in the answer to the last payload, None for none; returns the pause before the next [s].

        took_s: how long the exchange took.
        """
        if reply is None:
            return self._on_silence(took_s)
        if isinstance(reply, Refused):
            return self._on_refused(reply)
        head, limit = self._head, self._limit
        if not self._on_ack(reply, took_s):
            self.problem = f"the map server acknowledges {reply.watermark}, which is not what was sent"
            return self._back_off()
        self.problem, self._failures, self._has_met = "", 0, True
        took_all = head and 0 < len(head.rows) < limit and head.spool_id == self._spool.spool_id
        return self._config.gather_s if took_all else 0.0

    def on_disk_error(self, error: Exception) -> float:
        """Take in that the spool could not be read or written; returns the pause before the next try [s]."""
        self.counters["disk_errors"] += 1
        self.problem = f"the spool cannot be used: {error}; look at the machine's disk"
        return self._back_off()

    def on_bug(self, error: Exception) -> float:
        """Take in that an exchange failed in a way that was not foreseen; returns the pause before the next try [s]."""
        self.counters["bugs"] += 1
        self.problem = f"the uplink failed: {error!r}; its log has more"
        return self._back_off()

    def _on_silence(self, took_s: float) -> float:
        """No server answers at once with nothing; a link that is too slow for the batch uses up the time-out."""
        if took_s < self._config.timeout_s / 2:
            self.counters["unanswered"] += 1
            self.problem = "no map server answers; is one running, and does the router let this machine write?"
            return self._back_off()
        self.counters["timeouts"] += 1
        self.problem = f"no answer from the map server within {self._config.timeout_s:g} s"
        if self._head and len(self._head.rows):
            self._limit = max(1, len(self._head.rows) // 2)
        return self._back_off()

    def _on_ack(self, ack: Ack, took_s: float) -> bool:
        """Delete what is on the server's disk; returns whether that is at least the first sample of the batch."""
        head = self._head
        if head is None:
            return True
        if not len(head.rows):  # an earlier run is closed, whatever an older server makes of it
            self._spool.acknowledge(head.spool_id, max(ack.watermark, head.first_seq - 1))
            return True
        if head.spool_id == self._spool.spool_id and ack.watermark > self._spool.newest:
            # Only a machine that was copied or set back while it ran, memory and all, gives a number twice.
            self.counters["new_spool_ids"] += 1
            self._spool.fork()
            return True
        if ack.watermark < head.first_seq:
            return False
        self.counters["batches"] += 1
        self._spool.acknowledge(head.spool_id, ack.watermark)
        self._adapt(len(head.rows), took_s)
        return True

    def _adapt(self, n: int, took_s: float) -> None:
        """Fit the size of a batch to the link, by how long one of n samples took."""
        wanted_s, first = SHARE * self._config.timeout_s, self._config.batch_samples
        if took_s > wanted_s and n > first:  # smaller than at first only by time-outs: the delay may be the link's own
            self._limit = max(first, int(n * wanted_s / took_s))
        elif took_s <= wanted_s / 2:
            self._limit = min(max(self._limit, 2 * n), self._config.max_batch_samples)
        elif n < first and took_s < self._config.timeout_s / 2:
            self._limit = max(self._limit, n + 1 + n // 4)

    def _on_refused(self, refused: Refused) -> float:
        self.counters[f"refused_{refused.reason}"] += 1
        self.problem = refused.problem
        if refused.reason in PASSING or refused.reason in BLOCKING:
            return self._back_off()
        if self._head is None or not len(self._head.rows):
            return self._back_off()
        if refused.reason == Refusal.GAP:
            fell = refused.expected >= 1 and self._spool.fall_back(self._head.spool_id, refused.expected - 1)
            return 0.0 if fell else self._back_off()
        if len(self._head.rows) > 1:  # find the sample that is to blame
            self._limit = len(self._head.rows) // 2
            return 0.0
        self._spool.put_aside(self._head, refused.problem)
        log.error("put aside seq=%d problem=%r", self._head.first_seq, refused.problem)
        return 0.0

    def _back_off(self) -> float:
        self._failures += 1
        pause_s = min(self._config.backoff_s * 2 ** min(self._failures - 1, 10), self._config.max_backoff_s)
        return float(pause_s * self._rng.uniform(0.5, 1.0))


Sign = Callable[[str, bytes], bytes]  # key expression and payload to signature


class Uplink:
    """Runs an UplinkState over Zenoh on a thread of its own."""

    def __init__(
        self,
        session: zenoh.Session,
        site: str,
        machine: str,
        state: UplinkState,
        timeout_s: float,
        sign: Sign | None = None,
    ) -> None:
        """sign: makes the signature that goes beside each batch."""
        self.state = state
        self._sign = sign
        self._session = session
        self._key = keys.ingest(site, machine)
        self._timeout_s = timeout_s
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._cancel = zenoh.CancellationToken()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Say that there is something new to send."""
        self._wake.set()

    def close(self) -> None:
        """Stop, and wait for no answer: what it would say, the next start learns again."""
        self._stop.set()
        self._wake.set()
        self._cancel.cancel()  # type: ignore[no-untyped-call]
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            try:
                payload = self.state.next_payload()
                start_s = time.monotonic()
                pause_s = self.state.on_reply(self._ask(payload), time.monotonic() - start_s) if payload else None
            except sqlite3.Error as error:  # a full or failing disk: the samples wait, the agent goes on
                pause_s = self.state.on_disk_error(error)
            except Exception as error:  # a bug must not end the thread, and with it all delivery, without a word
                log.exception("uplink failed")
                pause_s = self.state.on_bug(error)
            if pause_s is None:
                self._wake.wait(0.5)
            elif pause_s > 0:
                self._stop.wait(pause_s)

    def _ask(self, payload: bytes) -> Ack | Refused | None:
        try:
            replies = self._session.get(
                self._key,
                payload=payload,
                attachment=self._sign(self._key, payload) if self._sign else None,
                timeout=self._timeout_s,
                cancellation_token=self._cancel,
            )
            for reply in replies:
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
