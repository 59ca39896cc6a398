"""Corrections among a machine's readings: what the subscriber takes, and what it refuses and counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from agents.drivers.zenoh import QUEUE_CORRECTIONS, WithCorrections
from protocol.machine.readings import Correction, Encoder, Reading
from protocol.wire import keys
from protocol.wire.correction_codec import encode_correction
from protocol.wire.messages import SiteCorrection
from tests.unit.agents.drives import SITE, START_NS

WHEELS = Encoder("wheels", START_NS, 1.0, 1.0)
CORRECTION = Correction("base-1", START_NS, 1.0, -1.0, 0.1, 1.0, 45.0, 0.0, 0.0, 0.1)


class FakeSession:
    def __init__(self) -> None:
        self.key, self.closed = "", False
        self.arrive: Callable[[Any], None] = lambda _: None

    def declare_subscriber(self, key: str, on_sample: Callable[[Any], None]) -> FakeSession:
        self.key, self.arrive = key, on_sample
        return self

    def undeclare(self) -> None:
        self.closed = True

    def put(self, payload: bytes) -> None:
        self.arrive(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


class FakeDriver:
    def __init__(self, *spans: Sequence[Reading] | None) -> None:
        self.spans, self.closed = list(spans), False

    def read(self, timeout_s: float) -> Sequence[Reading] | None:
        return self.spans.pop(0)

    def counters(self) -> Mapping[str, int]:
        return {"bundles_missing": 2}

    def problems(self) -> list[str]:
        return []

    def close(self) -> None:
        self.closed = True


def sent(correction: Correction = CORRECTION, frame: str = SITE.frame) -> bytes:
    return encode_correction(SiteCorrection(frame, correction))


def test_corrections_come_with_the_next_readings() -> None:
    session, driver = FakeSession(), FakeDriver([], [WHEELS], [WHEELS], None)
    merged: Any = WithCorrections(driver, session, SITE, "base-1")  # type: ignore[arg-type]
    assert session.key == keys.corrections(SITE.name, "base-1")
    session.put(sent())
    assert merged.read(0.1) == []  # nobody's clock but the machine's own
    assert merged.read(0.1) == [CORRECTION, WHEELS]
    assert merged.read(0.1) == [WHEELS]
    assert merged.read(0.1) is None
    merged.close()
    assert session.closed
    assert driver.closed


def test_what_is_wrong_is_refused_and_counted_by_its_reason() -> None:
    session, driver = FakeSession(), FakeDriver([WHEELS], [WHEELS])
    merged: Any = WithCorrections(driver, session, SITE, "base-1")  # type: ignore[arg-type]
    bad = [b"", sent()[:-1], sent(frame="fedcba98"), sent(replace(CORRECTION, sensor="base-2"))]
    bad += [sent(replace(CORRECTION, east_m=float("nan"))), sent(replace(CORRECTION, stamp_ns=2**62))]
    for payload in bad:
        session.put(payload)
    assert merged.read(0.1) == [WHEELS]
    assert merged.counters() == {
        "bundles_missing": 2,
        "refused_correction_not_msgpack": 2,
        "refused_correction_wrong_frame": 1,
        "refused_correction_wrong_base": 1,
        "refused_correction_not_finite": 1,
        "refused_correction_out_of_range": 1,
    }
    session.put(sent())
    assert merged.read(0.1) == [CORRECTION, WHEELS]


def test_machine_that_is_switched_off_keeps_the_newest_corrections() -> None:
    session, driver = FakeSession(), FakeDriver([WHEELS])
    merged: Any = WithCorrections(driver, session, SITE, "base-1")  # type: ignore[arg-type]
    for i in range(QUEUE_CORRECTIONS + 10):
        session.put(sent(replace(CORRECTION, stamp_ns=START_NS + i)))
    readings = merged.read(0.1)
    assert len(readings) == QUEUE_CORRECTIONS + 1
    assert readings[0].stamp_ns == START_NS + 10
    assert merged.counters()["corrections_overflowed"] == 10
