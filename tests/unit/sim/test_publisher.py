import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from protocol.errors import LinkError
from protocol.wire import keys
from protocol.wire.bundle_stream import StreamClock
from protocol.wire.codec import decode_bundle
from protocol.wire.messages import SensorBundle
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sim.config import SimConfig, resolve
from sim.publisher import run
from sim.simulator import Simulator

CONFIG = SimConfig(site="pit", world="fast", machines=2, seed=3, seconds=0.5, speed=0.0)


class Listener:
    """Stands in for agents: keeps bundles, and notes ends of streams."""

    def __init__(self, machines: tuple[str, ...]) -> None:
        self.bundles: dict[str, list[SensorBundle]] = {m: [] for m in machines}
        self.ended = {m: threading.Event() for m in machines}
        self.first = threading.Event()

    def hear(self, data: bytes) -> None:
        bundle = decode_bundle(data)
        self.bundles[bundle.machine].append(bundle)
        self.first.set()
        if bundle.last:
            self.ended[bundle.machine].set()


@contextmanager
def listening(session_config: SessionConfig, site: str, machines: tuple[str, ...]) -> Iterator[Listener]:
    listener = Listener(machines)
    session = open_session(session_config)
    try:
        subscribers = [
            session.declare_subscriber(keys.sensors(site, m), lambda sample: listener.hear(sample.payload.to_bytes()))
            for m in machines
        ]
        yield listener
        for subscriber in subscribers:
            subscriber.undeclare()
    finally:
        session.close()


def published(
    config: SimConfig,
    act: Callable[[Listener, threading.Event], None] = lambda *_: None,
    stop: threading.Event | None = None,
    **options,
):
    """Run the publisher as the router."""
    endpoint, stop = free_endpoint(), stop or threading.Event()
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(run, config, SessionConfig(endpoint, mode="router"), stop, **options)
        with listening(SessionConfig(endpoint, wait_s=10.0), "pit", resolve(config).machine_names) as listener:
            act(listener, stop)
            report = result.result(timeout=30)
            assert all(e.wait(10) for e in listener.ended.values()), "a stream has not ended"
    return report, listener.bundles


@pytest.mark.slow
def test_every_reading_arrives_in_counted_bundles(tmp_path: Path) -> None:
    report, bundles = published(CONFIG, truth_dir=tmp_path / "truth")
    assert (report.machines, report.bundles, report.stopped) == (2, 10, False)
    assert report.simulated_s == pytest.approx(0.5)
    simulator = Simulator(CONFIG)
    spans = [simulator.advance() for _ in range(10)]
    assert report.readings == sum(len(readings) for span in spans for readings in span.values())
    for machine, received in bundles.items():
        assert [b.counter for b in received] == list(range(1, 12))
        assert [b.last for b in received] == [False] * 10 + [True]
        assert [list(b.readings) for b in received] == [span[machine] for span in spans] + [[]]
        assert (tmp_path / "truth" / "tracks" / f"{machine}.csv").exists()
    assert (tmp_path / "truth" / "truth_map.npz").exists()


def test_stop_ends_the_streams_early_and_cleanly() -> None:
    def stop_at_first(listener: Listener, stop: threading.Event) -> None:
        assert listener.first.wait(20)
        stop.set()

    report, bundles = published(replace(CONFIG, seconds=0.0, speed=1.0), stop_at_first)
    assert report.stopped
    for received in bundles.values():
        assert received[-1].last
        assert len(received) == report.bundles + 1


def test_machine_without_an_agent_is_named() -> None:
    endpoint = free_endpoint()
    config = replace(CONFIG, names=("red", "blue"))
    with ThreadPoolExecutor(1) as pool:
        session_config = SessionConfig(endpoint, mode="router")
        result = pool.submit(run, config, session_config, threading.Event(), wait_s=0.2)
        with listening(SessionConfig(endpoint, wait_s=10.0), "pit", ("red",)), pytest.raises(LinkError, match="blue"):
            result.result(timeout=20)


class FakeStop(threading.Event):
    """Waiting advances the clock."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 100.0

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return False


def test_run_takes_as_long_as_its_speed_says() -> None:
    stop = FakeStop()
    config = replace(CONFIG, speed=4.0)
    report, _ = published(config, stop=stop, clock=lambda: stop.now, wait_s=1e6)
    assert report.wall_s == pytest.approx(0.125)


@pytest.mark.parametrize(("speed", "wall_s"), [(1.0, 12.0), (4.0, 3.0), (0.0, 0.0)])
def test_pace_holds_to_the_speed(speed: float, wall_s: float) -> None:
    stop = FakeStop()
    pace = StreamClock(speed, stop, lambda: stop.now)
    for i in range(1, 241):
        pace.wait(i * 0.05)
    assert stop.now - 100.0 == pytest.approx(wall_s)
    assert pace.late_s == 0.0


def test_pace_catches_up_and_tells_how_late_it_was() -> None:
    stop = FakeStop()
    pace = StreamClock(1.0, stop, lambda: stop.now)
    stop.now += 2.0
    pace.wait(0.5)
    assert pace.late_s == pytest.approx(1.5)
    pace.wait(3.0)
    assert stop.now == pytest.approx(103.0)
