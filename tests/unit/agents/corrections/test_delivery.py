"""Corrections at a machine, over Zenoh to the receivers' ports, and the sentences on failure."""

from __future__ import annotations

import os
import pty
import random
import socket
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from agents.corrections.delivery import (
    STALE_NS,
    WAITING,
    CorrectionsConfig,
    CorrectionsDelivery,
    CorrectionsState,
    OwnPort,
    open_delivery,
)
from agents.corrections.relay import Relay, RelayConfig
from agents.drivers.line import Line
from agents.drivers.receiver import ReceiverSource as DriverReceiver
from protocol.wire import keys
from protocol.wire.codec import encode_corrections
from protocol.wire.messages import Corrections
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from tests.patience import until
from tests.unit.agents.corrections.caster import Caster, sends
from tests.unit.agents.corrections.test_rtcm import frame
from tests.unit.agents.drives import SITE, START_NS

S = 10**9
FRAMES = [frame(random.Random(seed), 100) for seed in range(6)]
SAID = Corrections("base-1", START_NS, b"".join(FRAMES))


@pytest.fixture(scope="module")
def session() -> Iterator[Any]:
    session: Any = open_session(SessionConfig(free_endpoint(), mode="router"))
    yield session
    session.close()


class Receiver:
    """A receiver's TCP port that can be unplugged."""

    def __init__(self, port: int = 0) -> None:
        self.heard = b""
        self.caster = Caster(self._serve, port=port, asks=False)
        self.address = f"tcp://127.0.0.1:{self.caster.port}"

    def _serve(self, link: socket.socket) -> None:
        link.sendall(b"$GPGGA,\r\n" * 100)  # nobody reads it
        while data := link.recv(4096):
            self.heard += data


@contextmanager
def delivering(session: Any, *addresses: str, ports: dict[str, Any] | None = None) -> Iterator[CorrectionsDelivery]:
    delivery = open_delivery(session, SITE.name, CorrectionsConfig("base-1", addresses), ports or {})
    assert delivery
    try:
        yield delivery
    finally:
        delivery.close()


def test_frames_of_a_base_reach_a_serial_port_and_one_of_tcp(session: Any) -> None:
    pytest.importorskip("serial")
    wire, device = pty.openpty()
    tty.setraw(wire)
    heard = bytearray()
    receiver = Receiver()
    relayed = threading.Event()
    with Caster(sends(b"noise" + SAID.frames), asks=False) as base, receiver.caster:
        config = RelayConfig("base-1", f"tcp://127.0.0.1:{base.port}")
        key = keys.corrections(SITE.name, "base-1")
        relay = Relay(lambda payload: session.put(key, payload), config, SITE)
        with delivering(session, os.ttyname(device), receiver.address) as delivery:
            running = threading.Thread(target=relay.run, args=(relayed,))
            running.start()
            while len(heard) < len(SAID.frames):
                heard += os.read(wire, 4096)
            until(lambda: len(receiver.heard) >= len(SAID.frames), "frames at the port of TCP")
            report = delivery.report()
            relayed.set()
            running.join()
    os.close(wire)
    os.close(device)
    assert bytes(heard) == receiver.heard == SAID.frames
    assert report["counters"] == {"frames": len(FRAMES)}
    assert report["problem"] == ""
    assert 0 <= report["age_s"] < 60


def test_a_receiver_that_is_unplugged_is_named_and_gets_the_next_ones_when_it_is_back(session: Any) -> None:
    receiver = Receiver()
    key, said = keys.corrections(SITE.name, "base-1"), encode_corrections(SAID)
    with delivering(session, receiver.address) as delivery:
        session.put(key, said)
        until(lambda: receiver.heard == SAID.frames, "frames")
        receiver.caster.kill()

        def is_noticed() -> bool:
            session.put(key, said)  # the first may still fit the socket's buffer
            return "corrections do not reach tcp://" in delivery.report()["problem"]

        until(is_noticed, "the receiver missed")
        again = Receiver(receiver.caster.port)
        with again.caster:
            until(lambda: session.put(key, said) or again.heard, "frames again")
            until(lambda: not delivery.report()["problem"], "no problem any more")


def test_the_port_that_a_driver_reads_takes_corrections_too(session: Any) -> None:
    receiver = Receiver()
    source = DriverReceiver(receiver.address, 0, "ubx", Line("ubx", {}))
    key, said = keys.corrections(SITE.name, "base-1"), encode_corrections(SAID)
    with receiver.caster, delivering(session, receiver.address, ports={receiver.address: source}) as delivery:
        session.put(key, said)
        until(lambda: "has no link" in delivery.report()["problem"], "a port that is not open")
        source.read(0.1)
        session.put(key, said)
        until(lambda: receiver.heard == SAID.frames, "frames")
        until(lambda: not delivery.report()["problem"], "no problem any more")


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (encode_corrections(replace(SAID, frames=SAID.frames[:-1])), "refused_crc"),
        (encode_corrections(replace(SAID, frames=SAID.frames + b"$")), "refused_crc"),
        (encode_corrections(replace(SAID, frames=b"\xb5\x62\x06\x04\x04\x00")), "refused_crc"),  # a u-blox command
        (encode_corrections(replace(SAID, base="base-2")), "refused_out_of_range"),
        (b"\xff", "refused_not_msgpack"),
        (bytes(70_000), "refused_too_large"),
    ],
)
def test_nothing_but_whole_frames_of_its_base_reaches_a_receiver(session: Any, payload: bytes, reason: str) -> None:
    receiver = Receiver()
    with receiver.caster, delivering(session, receiver.address) as delivery:
        session.put(keys.corrections(SITE.name, "base-1"), payload)
        until(lambda: delivery.report()["counters"], "refused")
        assert delivery.report()["counters"] == {reason: 1}
        session.put(keys.corrections(SITE.name, "base-1"), encode_corrections(SAID))
        until(lambda: receiver.heard, "frames")
    assert SAID.frames.startswith(receiver.heard)


def test_a_port_that_takes_little_at_a_time_gets_all_and_one_that_takes_nothing_is_named(session: Any) -> None:
    frames = b"".join(FRAMES) * 5000  # beyond any buffer
    receiver = Receiver()
    with receiver.caster:
        port = OwnPort(receiver.address, 9600)
        port.write(frames)
        until(lambda: len(receiver.heard) == len(frames), "all of it")
        port.close()
    assert receiver.heard == frames
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        port = OwnPort(f"tcp://127.0.0.1:{deaf.getsockname()[1]}", 9600)
        with pytest.raises(OSError, match="takes no bytes"):
            port.write(frames * 3)


def test_a_port_that_hangs_costs_old_messages_alone(session: Any) -> None:
    class Stuck:
        writes = 0
        goes_on = threading.Event()

        def write(self, _: bytes) -> None:
            self.writes += 1
            self.goes_on.wait()

        def close(self) -> None:
            self.writes = -1

    stuck, key = Stuck(), keys.corrections(SITE.name, "base-1")
    delivery = CorrectionsDelivery(session, SITE.name, "base-1", {"stuck": stuck})
    session.put(key, encode_corrections(SAID))
    until(lambda: stuck.writes, "the first message")
    for _ in range(200):
        session.put(key, encode_corrections(SAID))
    stuck.goes_on.set()
    until(lambda: stuck.writes == 1 + WAITING, "those that wait")
    delivery.close()
    assert stuck.writes == -1
    assert delivery.report()["counters"] == {"frames": (1 + WAITING) * len(FRAMES)}


# --- sentences --------------------------------------------------------------------------------------------------------


def after(*messages: tuple[float, float, str | None], state: CorrectionsState | None = None) -> CorrectionsState:
    """State after messages: stamp, arrival, problem (None: frames)."""
    state = state or CorrectionsState("base-1", 0)
    for stamp_s, came_s, problem in messages:
        frames = SAID.frames if problem is None else b""
        message = Corrections("base-1", START_NS + round(stamp_s * S), frames, problem or "")
        state = state.after(message, round(came_s * S))
    return state


@pytest.mark.parametrize(
    ("state", "now_s", "words"),
    [
        (after(), 59.0, ""),
        (after(), 61.0, "base-1: silent for 61 s: start `sitegrid corrections`, or mend its link"),
        (after((100.0, 1.0, None)), 60.0, ""),
        (after((100.0, 1.0, None)), 62.0, "base-1: silent for 61 s"),
        (
            after((100.0, 1.0, None), (160.0, 61.0, "")),
            62.0,
            "base-1: the last correction is 61 s old: is the base on?",
        ),
        (after((100.0, 1.0, None), (101.0, 2.0, "caster:2101: no")), 3.0, "base-1: caster:2101: no"),
        (after((100.0, 1.0, ""), (101.0, 2.0, None)), 3.0, ""),
        (after((0.0, 1.0, None), (1.0, 42.0, None)), 63.0, "base-1: the last correction is 61 s old"),  # held up
    ],
)
def test_a_stale_base_is_named(state: CorrectionsState, now_s: float, words: str) -> None:
    said = state.problem(round(now_s * S))
    assert said.startswith(words) if words else not said


@pytest.mark.parametrize("set_s", [-7200.0, -1e6, 3600.0, 1e6])
def test_clocks_that_are_wrong_or_set_make_no_correction_old(set_s: float) -> None:
    state = after((0.0, 5.0, None), (1.0, 6.0, None), (2.0 + set_s, 7.0, None))
    assert state.true_ns == 7 * S
    assert after((3.0 + set_s, 8.5, None), state=state).true_ns == pytest.approx(8 * S, abs=0.02 * S)


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_clocks_that_run_apart_for_weeks_make_no_correction_old(drift: float) -> None:
    state = CorrectionsState("base-1", 0)
    for came_s in range(0, 30 * 86_400, 600):
        state = after((came_s * (1 + drift), came_s, None), state=state)
        assert state.true_ns == pytest.approx(came_s * S, abs=0.1 * S)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"base": "Base 1", "ports": ("a",)}, "not a name"),
        ({"base": "base-1"}, "one is of no use"),
        ({"ports": ("/dev/ttyACM0",)}, "one is of no use"),
    ],
)
def test_a_table_that_cannot_be_is_refused(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        CorrectionsConfig(**options)


def test_a_machine_without_a_base_listens_to_none(session: Any) -> None:
    assert open_delivery(session, SITE.name, CorrectionsConfig(), {}) is None
    with pytest.raises(OSError, match="refused"):
        OwnPort(f"tcp://127.0.0.1:{_closed()}", 9600).write(b"x")
    assert STALE_NS == 60 * S


def _closed() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
