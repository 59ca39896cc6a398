"""Corrections of a base station over Zenoh, among the readings of a machine's own driver."""

import queue
from collections import Counter
from collections.abc import Mapping, Sequence

import zenoh

from agents.drivers import Driver
from protocol.errors import MessageError
from protocol.machine.readings import Reading
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.correction_codec import decode_correction

QUEUE_CORRECTIONS = 1000  # 200 s of them; beyond it the oldest are dropped and counted


class WithCorrections:
    """Driver that adds corrections to the readings of another one; the callback only moves bytes to a queue.

    They come without order among the others: a link may hold them up for seconds.
    """

    def __init__(self, driver: Driver, session: zenoh.Session, site: SiteConfig, base: str) -> None:
        self._driver, self._frame, self._base = driver, site.frame, base
        self._queue: queue.Queue[bytes] = queue.Queue(QUEUE_CORRECTIONS)
        self._counters: Counter[str] = Counter()
        self._subscriber = session.declare_subscriber(keys.corrections(site.name, base), self._on_sample)

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """Readings of the machine, and before them the corrections that have come in; none without readings."""
        readings = self._driver.read(timeout_s)
        return [*self._corrections(), *readings] if readings else readings

    def counters(self) -> Mapping[str, int]:
        """What the driver counts, and corrections that were lost or refused, by reason."""
        return {**self._driver.counters(), **self._counters}

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._driver.close()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        while True:
            try:
                self._queue.put_nowait(sample.payload.to_bytes())
            except queue.Full:
                self._drop_oldest()
            else:
                return

    def _drop_oldest(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return
        self._counters["corrections_overflowed"] += 1

    def _corrections(self) -> list[Reading]:
        corrections: list[Reading] = []
        while True:
            try:
                payload = self._queue.get_nowait()
            except queue.Empty:
                return corrections
            try:
                corrections += self._decode(payload)
            except MessageError as error:
                self._counters[f"refused_correction_{error.reason}"] += 1

    def _decode(self, payload: bytes) -> list[Reading]:
        correction = decode_correction(payload, self._frame).correction
        if correction.sensor != self._base:
            self._counters["refused_correction_wrong_base"] += 1
            return []
        return [correction]
