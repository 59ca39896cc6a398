"""Events for a callback that may be slow: a slow callback of Zenoh itself stalls the session."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections import Counter
from collections.abc import Callable
from typing import Generic, TypeVar

import zenoh

from protocol.errors import MessageError

MOST_WAITING = 1000  # events; more are dropped
T = TypeVar("T")
log = logging.getLogger("sitegrid.listener")


class Listener(Generic[T]):
    """Calls `callback` with every event put on a key, one after the other, on a thread of its own, until closed.

    Events that cannot be read, or come faster than the callback returns, are dropped; its errors are logged.
    refused: how many could not be read, by reason.
    """

    def __init__(
        self, session: zenoh.Session, key: str, decode: Callable[[str, bytes], T], callback: Callable[[T], object]
    ) -> None:
        """decode: key and payload to event, or MessageError."""
        self.refused: Counter[str] = Counter()
        self._decode, self._callback = decode, callback
        self._closed = False
        self._waiting: queue.Queue[tuple[str, bytes] | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._run, name="listener", daemon=True)
        self._thread.start()
        self._subscriber = session.declare_subscriber(key, self._on_sample)

    def close(self) -> None:
        """Stop listening; returns once the callback has. May be called again, and from the callback itself."""
        if self._closed:
            return
        self._closed = True
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        with contextlib.suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
        self._waiting.put(None)
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        try:
            self._waiting.put_nowait((str(sample.key_expr), sample.payload.to_bytes()))
        except queue.Full:
            log.warning("event dropped key=%s waiting=%d", sample.key_expr, MOST_WAITING)

    def _run(self) -> None:
        while (event := self._waiting.get()) is not None:
            try:
                self._callback(self._decode(*event))
            except MessageError as error:
                self.refused[error.reason] += 1
                if self.refused[error.reason].bit_count() == 1:  # the first, second, fourth...: who floods fills no log
                    log.warning("event refused key=%s reason=%s problem=%r", event[0], error.reason, str(error))
            except Exception:  # the callback's bug is not the end of the events
                log.exception("callback failed")
