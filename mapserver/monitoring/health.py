"""Health of the agents, as they publish it on Zenoh (docs/protocol.md)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import zenoh

from protocol.errors import ConfigError, MessageError
from protocol.wire import keys
from protocol.wire.codec import MAX_SMALL_BYTES, decode_health

MOST_AGENTS = 1000  # names are free to choose where there are no keys


@dataclass(frozen=True)
class ReceivedHealth:
    """The newest health of one agent: its values, and the server's clock when it came in [s since 1970]."""

    values: Mapping[str, Any]
    received_s: float


class HealthListener:
    """Keeps the newest health of every agent of a site as bytes until somebody asks: callbacks only move bytes."""

    def __init__(self, session: zenoh.Session, site: str, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._newest: dict[str, tuple[bytes, float]] = {}
        self._subscriber = session.declare_subscriber(keys.health_all(site), self._on_health)

    def received(self) -> dict[str, ReceivedHealth]:
        """By machine, without health that cannot be read, or that came under the key of another machine."""
        readable = {}
        for name, (data, received_s) in sorted(self._newest.copy().items()):
            try:
                health = decode_health(data)
            except MessageError:
                continue
            if health.machine == name:
                readable[name] = ReceivedHealth(health.values, received_s)
        return readable

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_health(self, sample: zenoh.Sample) -> None:
        try:
            machine = keys.machine_of(str(sample.key_expr))
        except ConfigError:  # a wildcard names no machine
            return
        data = sample.payload.to_bytes()
        if len(data) <= MAX_SMALL_BYTES and (machine in self._newest or len(self._newest) < MOST_AGENTS):
            self._newest[machine] = (data, self._clock())
