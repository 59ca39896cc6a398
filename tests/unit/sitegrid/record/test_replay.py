"""Bundles of recorded readings keep the order in which the agent took them."""

from __future__ import annotations

import random
import threading
from typing import Any

import pytest

from agents.drivers.replay import SPAN_NS
from protocol.errors import LinkError
from protocol.machine.readings import Reading, parse_reading
from protocol.machine.recorded_readings import RecordedReading
from protocol.machine.samples import empty
from protocol.wire.codec import decode_bundle, encode_batch, encode_bundle
from protocol.wire.messages import SampleBatch, SensorBundle
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid.record import replay
from sitegrid.record.replay import MOST_READINGS, Agents, SampleSender, bundles

SEED = 11
SENSORS = {"imu": ("torque", 1), "wheels": ("encoder", 2), "pole": ("articulation", 1)}


def reading(sensor: str, stamp_ns: int, value: float) -> Reading:
    kind, count = SENSORS[sensor]
    return parse_reading(kind, sensor, stamp_ns, (value,) * count)


def test_bundles_keep_the_order_of_each_machine_whatever_its_stamps():
    draw = random.Random(SEED)
    taken = [
        RecordedReading(
            draw.choice(("a", "b")), i * SPAN_NS // 40, reading(draw.choice([*SENSORS]), draw.randint(1, 4), i / 1e5)
        )
        for i in range(4000)
    ]
    for machine in ("a", "b"):
        sent = [
            decoded
            for name, _, readings in bundles(taken)
            if name == machine
            for decoded in decode_bundle(encode_bundle(SensorBundle(name, 1, tuple(readings)))).readings
        ]
        assert sent == [one.reading for one in taken if one.machine == machine]


def test_bundles_are_as_long_as_live_ones():
    steady = [RecordedReading("a", i * 10**6, reading("imu", 1 + i, 0.5)) for i in range(1000)]
    assert {len(readings) for _, _, readings in bundles(steady)} == {50}
    at_once = [RecordedReading("a", 1, reading("imu", 1 + i, 0.5)) for i in range(2500)]
    assert max(len(readings) for _, _, readings in bundles(at_once)) == MOST_READINGS


def test_without_an_agent_or_a_map_server_a_replay_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replay, "SILENT_S", 0.2)
    session: Any = open_session(SessionConfig(endpoint := free_endpoint(), mode="router"))
    agents = Agents(session, endpoint, "paper", stop := threading.Event())
    with pytest.raises(LinkError, match="no agent of a runs on site paper: start one"):
        agents.feed("a", [reading("imu", 1, 0.5)])
    batch = encode_batch(SampleBatch("a", 1, 1, empty(), "0" * 8))
    with pytest.raises(LinkError, match="no map server of site paper takes samples of a"):
        SampleSender(session, endpoint, "paper", None).send("a", batch, stop)
    agents.close()
    session.close()
