"""Readings over Zenoh: bundles of a simulated machine or remote driver, alone or with receivers."""

import queue
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import zenoh

from agents.drivers import Driver, Observed
from protocol.errors import MessageError
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Reading, columns
from protocol.wire import keys
from protocol.wire.codec import decode_bundle

ZENOH = "zenoh"
QUEUE_BUNDLES = 4000  # capacity: 200 s of bundles; further ones are dropped and counted


class ZenohDriver:
    """Subscribes to the machine's `sensors` key; the callback only queues bytes."""

    def __init__(self, session: zenoh.Session, site: str, machine: str) -> None:
        self._machine = machine
        self._queue: queue.Queue[bytes] = queue.Queue(QUEUE_BUNDLES)
        self._counters: Counter[str] = Counter()
        self._newest = 0
        self._ended = False
        self._subscriber = session.declare_subscriber(keys.sensors(site, machine), self._on_sample)

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        """Readings of the next bundle."""
        if self._ended:
            return None
        try:
            return self._decode(self._queue.get(timeout=timeout_s))
        except queue.Empty:
            return ()

    def counters(self) -> Mapping[str, int]:
        """Lost or refused bundles, and refused readings, by reason."""
        return dict(self._counters)

    def problems(self) -> Sequence[str]:
        """None: publishers are unknown."""
        return ()

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        try:
            self._queue.put_nowait(sample.payload.to_bytes())
        except queue.Full:
            self._counters["bundles_overflowed"] += 1

    def _decode(self, payload: bytes) -> Sequence[Reading]:
        try:
            bundle = decode_bundle(payload)
        except MessageError as error:
            self._counters[f"refused_bundle_{error.reason}"] += 1
            return ()
        if bundle.machine != self._machine:
            self._counters["refused_bundle_wrong_machine"] += 1
            return ()
        self._count_gap(bundle.counter)
        for reason, n in bundle.refused.items():
            self._counters[f"refused_reading_{reason}"] += n
        self._ended = bundle.last
        return bundle.readings

    def _count_gap(self, counter: int) -> None:
        """Count missing bundles; a counter of 1 starts a new stream."""
        if counter > self._newest + 1 and self._newest:
            self._counters["bundles_missing"] += counter - self._newest - 1
        self._newest = counter


class BundleSource:
    """Source of readings in bundles, with stamps in UTC. feeds: sensor by its name there."""

    def __init__(
        self, bundles: Driver, feeds: Mapping[str, SensorConfig], clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._bundles, self._feeds, self._clock_ns = bundles, feeds, clock_ns
        self._counters: Counter[str] = Counter()

    def read(self, timeout_s: float) -> Sequence[Observed] | None:
        """Values of the next bundle."""
        readings = self._bundles.read(timeout_s)
        return None if readings is None else [value for reading in readings if (value := self._observed(reading))]

    def counters(self) -> Mapping[str, int]:
        """Those of bundles, and readings of a wrong kind."""
        return {**self._bundles.counters(), **dict(self._counters)}

    def problems(self) -> Sequence[str]:
        """None: publishers are unknown."""
        return ()

    def close(self) -> None:
        """Stop listening."""
        self._bundles.close()

    def _observed(self, reading: Reading) -> Observed | None:
        sensor = self._feeds.get(reading.sensor)
        if sensor is None:
            return None
        if sensor.kind != reading.kind:
            self._counters["refused_reading_wrong_kind"] += 1
            return None
        values = tuple(getattr(reading, name) for name in columns(reading.kind))
        return Observed(sensor.name, reading.kind, values, self._clock_ns(), reading.stamp_ns)
