"""Readings published over Zenoh in bundles, at a multiple of real time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import zenoh

from protocol.machine.readings import Reading
from protocol.wire import keys
from protocol.wire.codec import encode_bundle
from protocol.wire.messages import SensorBundle


class BundleStream:
    """A machine's bundles, counted 1, 2, 3..."""

    def __init__(self, session: zenoh.Session, site: str, machine: str) -> None:
        self.machine = machine
        self._counter = 0
        # a slow agent delays the sender, and loses no readings
        block = zenoh.CongestionControl.BLOCK
        self._publisher: Any = session.declare_publisher(keys.sensors(site, machine), congestion_control=block)

    @property
    def has_subscriber(self) -> bool:
        """Whether an agent subscribes."""
        return bool(self._publisher.matching_status.matching)

    def put(self, readings: tuple[Reading, ...] = (), *, last: bool = False) -> None:
        """Publish the next bundle."""
        self._counter += 1
        self._publisher.put(encode_bundle(SensorBundle(self.machine, self._counter, readings, last)))

    def close(self) -> None:
        """Publish the last bundle and withdraw."""
        self.put(last=True)
        self._publisher.undeclare()


class StreamClock:
    """Limits reading time to `speed` times the clock's; 0 for unlimited."""

    def __init__(self, speed: float, stop: threading.Event, clock: Callable[[], float]) -> None:
        self._speed, self._stop, self._clock = speed, stop, clock
        self._start = clock()
        self.late_s = 0.0

    def wait(self, since_begin_s: float) -> None:
        """Wait until this reading time is due, or a stop."""
        if not self._speed:
            return
        early_s = self._start + since_begin_s / self._speed - self._clock()
        self.late_s = max(self.late_s, -early_s)
        if early_s > 0:
            self._stop.wait(early_s)
