"""The uplink's thread: it carries out the actions of an `Uplink`, on the spool's file and over Zenoh."""

import logging
import threading
import time
from collections.abc import Callable

import zenoh

from agents.delivery.spool import Spool
from agents.delivery.uplink import (
    Action,
    DeclareAgain,
    Delete,
    LowerWatermark,
    Quarantine,
    ReadHead,
    Send,
    StartNewRun,
    Uplink,
    Wait,
)
from protocol.errors import MessageError, Refusal, StoreError
from protocol.wire import keys
from protocol.wire.codec import decode_reply
from protocol.wire.messages import Ack, Refused

log = logging.getLogger("agents.delivery.uplink_thread")

Sign = Callable[[str, bytes], bytes]  # key expression and payload to signature
Check = Callable[[str, bytes, bytes, bytes], bool]  # key expression, payload, reply, signature: whether it is genuine
Ask = Callable[[bytes], tuple[Ack | Refused | None, float]]  # payload to reply (None: none), and how long it took [s]


def perform(action: Action, uplink: Uplink, spool: Spool, ask: Ask) -> Action:
    """Carry out an action and return the next one; pauses are up to the caller."""
    try:
        match action:
            case Wait():
                return uplink.start_exchange()
            case ReadHead(limit):
                return uplink.on_head(spool.head(limit), spool.spool_id)
            case Send(payload):
                return uplink.on_reply(*ask(payload))
            case Delete(spool_id, watermark, store):
                spool.acknowledge(spool_id, watermark, store)
            case LowerWatermark(spool_id, watermark):
                log.warning("the map server has lost samples run=%016x until=%d", spool_id, watermark)
                spool.lower_watermark(spool_id, watermark)
            case DeclareAgain():
                log.warning("the map server has lost journal rows: all runs are declared again")
                spool.declare_again()
            case StartNewRun():
                spool.start_new_run()
            case Quarantine(head, problem):
                spool.quarantine(head, problem)
                log.error("quarantined seq=%d problem=%r", head.first_seq, problem)
        return uplink.on_stored(action)
    except StoreError as error:  # a full or failing disk: the samples wait, the agent goes on
        return uplink.on_disk_error(error)


class UplinkThread:
    """Runs an uplink on a thread of its own."""

    def __init__(
        self,
        session: zenoh.Session,
        site: str,
        uplink: Uplink,
        spool: Spool,
        sign: Sign | None = None,
        check: Check | None = None,
    ) -> None:
        """sign: makes the signature that goes beside each batch; check: of that beside each reply."""
        self._session = session
        self._key = keys.ingest(site, uplink.machine)
        self._uplink = uplink
        self._spool = spool
        self._sign, self._check = sign, check
        self._new_samples = threading.Event()
        self._logged = ""
        self._stop = threading.Event()
        self._cancel = zenoh.CancellationToken()
        self._thread = threading.Thread(target=self._run, name="uplink", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Announce new samples in the spool."""
        self._new_samples.set()

    def close(self) -> None:
        """Stop, and wait for no reply: the next start learns from the server what it would have said."""
        self._stop.set()
        self._new_samples.set()
        self._cancel.cancel()  # type: ignore[no-untyped-call]
        self._thread.join()

    def _run(self) -> None:
        action: Action = Wait(0.0)
        while not self._stop.is_set():
            try:
                if isinstance(action, Wait):
                    self._pause(action)
                action = perform(action, self._uplink, self._spool, self._ask)
                self._tell()
            except Exception as error:  # a bug must not end the thread, and with it all delivery, without a word
                log.exception("uplink failed")
                action = self._uplink.on_bug(error)

    def _tell(self) -> None:
        """Log what a person has to mend, once: it does not pass by itself, as a link that is down does."""
        if (stuck := self._uplink.stuck) and stuck != self._logged:
            log.error("samples wait problem=%r", stuck)
        self._logged = stuck

    def _pause(self, pause: Wait) -> None:
        if pause.for_samples:
            self._new_samples.wait(pause.seconds)
        elif pause.seconds > 0:
            self._stop.wait(pause.seconds)
        self._new_samples.clear()  # the head is read after this: no sample is overlooked

    def _ask(self, payload: bytes) -> tuple[Ack | Refused | None, float]:
        start_s = time.monotonic()
        reply = self._query(payload)
        return reply, time.monotonic() - start_s

    def _query(self, payload: bytes) -> Ack | Refused | None:
        try:
            replies = self._session.get(
                self._key,
                payload=payload,
                attachment=self._sign(self._key, payload) if self._sign else None,
                timeout=self._uplink.timeout_s,
                cancellation_token=self._cancel,
            )
            for reply in replies:
                if reply.ok is not None:
                    return self._believed(payload, reply.ok)
        except (zenoh.ZError, MessageError) as error:
            log.warning("no usable answer error=%r", str(error))
        return None

    def _believed(self, payload: bytes, reply: zenoh.Sample) -> Ack | Refused:
        """What a reply says, if the map server has signed it; a forged one could have samples deleted."""
        data = reply.payload.to_bytes()
        signature = reply.attachment.to_bytes() if reply.attachment else b""
        if self._check and not self._check(self._key, payload, data, signature):
            problem = "the reply is not signed by the site's map server: compare the server's keys with servers.pub"
            return Refused(Refusal.UNSIGNED, problem)
        return decode_reply(data)


def linger(is_empty: Callable[[], bool], wait: Callable[[float], object], clock: Callable[[], float], s: float) -> bool:
    """Wait until the spool is empty, at most `s` seconds; returns whether it is."""
    end_s = clock() + s
    while not is_empty():
        if clock() >= end_s:
            return False
        wait(0.05)
    return True
