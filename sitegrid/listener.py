"""Events for slow callbacks: a slow callback of Zenoh itself stalls the session."""

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

MOST_WAITING = 1000  # capacity; further events are dropped
T = TypeVar("T")
log = logging.getLogger("sitegrid.listener")


class Listener(Generic[T]):
    """Calls `callback` with every event on a key, in order, on its own thread, until closed.

    Unreadable and overflowing events are dropped; errors of the callback are logged. refused: unreadable events by
    reason.
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
        """Stop listening and wait for the callback. Idempotent, and allowed inside the callback."""
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
                if self.refused[error.reason].bit_count() == 1:  # 1st, 2nd, 4th...: a flood does not fill the log
                    log.warning("event refused key=%s reason=%s problem=%r", event[0], error.reason, str(error))
            except Exception:  # a bug in the callback does not end the events
                log.exception("callback failed")
