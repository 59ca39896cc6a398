"""The uplink's thread performs the actions of an `Uplink` on the spool and over Zenoh."""

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

Sign = Callable[[str, bytes], bytes]  # (key expression, payload) to signature
Check = Callable[[str, bytes, bytes, bytes], bool]  # (key expression, payload, reply, signature) to whether it is valid
Ask = Callable[[bytes], tuple[Ack | Refused | None, float]]  # payload to (reply or None, duration [s])


def perform(action: Action, uplink: Uplink, spool: Spool, ask: Ask) -> Action:
    """Perform an action and return the next one; the caller does the pauses."""
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
    except StoreError as error:  # full or failing disk: samples wait, the agent goes on
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
        """Start; `sign` signs each batch, `check` verifies each reply's signature."""
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
        """Announce new samples."""
        self._new_samples.set()

    def close(self) -> None:
        """Stop without waiting for a reply; the next start asks the server again."""
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
            except Exception as error:  # a bug must not silently end delivery
                log.exception("uplink failed")
                action = self._uplink.on_bug(error)

    def _tell(self) -> None:
        """Log once what a person has to fix, unlike a link that recovers by itself."""
        if (stuck := self._uplink.stuck) and stuck != self._logged:
            log.error("samples wait problem=%r", stuck)
        self._logged = stuck

    def _pause(self, pause: Wait) -> None:
        if pause.for_samples:
            self._new_samples.wait(pause.seconds)
        elif pause.seconds > 0:
            self._stop.wait(pause.seconds)
        self._new_samples.clear()  # before the head is read, so no sample is overlooked

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
        """The reply, if the map server has signed it: a forged one could delete samples."""
        data = reply.payload.to_bytes()
        signature = reply.attachment.to_bytes() if reply.attachment else b""
        if self._check and not self._check(self._key, payload, data, signature):
            problem = "the reply is not signed by the site's map server: compare the server's keys with servers.pub"
            return Refused(Refusal.UNSIGNED, problem)
        return decode_reply(data)


def linger(is_empty: Callable[[], bool], wait: Callable[[float], object], clock: Callable[[], float], s: float) -> bool:
    """Wait at most `s` seconds for an empty spool; returns whether it is empty."""
    end_s = clock() + s
    while not is_empty():
        if clock() >= end_s:
            return False
        wait(0.05)
    return True
