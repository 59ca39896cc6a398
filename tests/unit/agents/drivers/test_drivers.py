from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.agent import Agent, Places
from agents.config import AgentConfig
from agents.delivery.audit import read_audit
from agents.delivery.uplink import UplinkConfig
from agents.drivers import Observed
from agents.drivers.replay import Replay
from agents.drivers.sources import Sources
from agents.drivers.time_base import TimeBase
from agents.drivers.zenoh import BundleSource, ZenohDriver
from protocol.machine.log_folder import open_log, write_log
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Articulation, Imu, Reading, Torque
from protocol.units import GRAVITY_MPS2
from protocol.wire import keys
from protocol.wire.codec import encode_bundle
from protocol.wire.messages import SensorBundle
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from tests.patience import until
from tests.unit.agents.drivers.frames import Script
from tests.unit.agents.drives import SITE, START_NS, VEHICLE, Leg, changed_sensor, drive, thinned


class Time:
    """A clock moved only by waiting."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.waits: list[float] = []

    def clock(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.now_s += seconds


# --- replay ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of driving, two silent, one of driving."""
    path = tmp_path_factory.mktemp("log")
    made = drive([Leg(5, 0.5)], VEHICLE)
    silent = (START_NS + 2 * 10**9, START_NS + 4 * 10**9)
    write_log(path, "lot", SITE, VEHICLE, [r for r in made.readings if not silent[0] < r.stamp_ns < silent[1]])
    return path


def replay(folder: Path, speed: float) -> tuple[list[Reading], list[float], Time, int]:
    """All readings, their times of release, number of empty reads."""
    time_ = Time()
    driver = Replay(open_log(folder), speed, time_.clock, time_.wait)
    readings: list[Reading] = []
    at: list[float] = []
    empty = 0
    while (span := driver.read(0.2)) is not None:
        readings += span
        at += [time_.now_s - 1000.0] * len(span)
        empty += not span
    driver.close()
    assert driver.read(0.2) is None
    return readings, at, time_, empty


def test_replay_as_fast_as_possible_hands_on_every_reading_in_order_and_never_waits(folder: Path) -> None:
    readings, _, time_, _ = replay(folder, 0.0)
    assert readings == list(open_log(folder).readings())
    assert time_.waits == []


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_replay_keeps_pace(folder: Path, speed: float) -> None:
    readings, at, time_, empty = replay(folder, speed)
    assert readings == list(open_log(folder).readings())
    assert max(time_.waits) <= 0.2, "no longer than a read may take"
    due = [(r.stamp_ns - readings[0].stamp_ns) * 1e-9 / speed for r in readings]
    early = [d - a for d, a in zip(due, at, strict=True)]
    assert max(early) <= 0.05 / speed + 1e-6  # released together at most
    assert min(early) >= -1e-6
    assert empty or speed > 1  # silence longer than a read's limit


def test_replay_hands_on_readings_with_too_early_stamps_when_they_were_true(tmp_path: Path) -> None:
    """With the pauses of right stamps."""
    made = drive([Leg(3, 0.5)], VEHICLE).readings
    write_log(tmp_path / "right", "lot", SITE, VEHICLE, made)
    early = [replace(r, stamp_ns=r.stamp_ns - 700_000_000) if r.sensor == "gps-1" else r for r in made]
    write_log(tmp_path / "early", "lot", SITE, changed_sensor(VEHICLE, "gps-1", delay_s=-0.7), early)
    right, early = (replay(tmp_path / name, 1.0) for name in ("right", "early"))
    mended = [replace(r, stamp_ns=r.stamp_ns + 700_000_000) if r.sensor == "gps-1" else r for r in early[0]]
    assert mended == right[0]
    assert early[1] == pytest.approx(right[1])


def test_replay_counts_rows_that_were_refused(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with (tmp_path / "torque.csv").open("a") as file:
        file.write(f"{START_NS + 9 * 10**9},1e9\n{START_NS + 9 * 10**9},nan\n{START_NS},0.0\nwhat,0.0\n")
    driver = Replay(open_log(tmp_path), 0.0, lambda: 0.0, lambda _: None)
    while driver.read(0.2) is not None:
        pass
    expected = {"log_out_of_range": 1, "log_not_finite": 1, "log_stamp_goes_back": 1, "log_wrong_type": 1}
    assert driver.counters() == expected


# --- Zenoh -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sessions() -> Iterator[tuple[Any, Any]]:
    """A router in this process and its client."""
    endpoint = free_endpoint()
    router: Any = open_session(SessionConfig(endpoint, mode="router"))
    client: Any = open_session(SessionConfig(endpoint))
    yield router, client
    client.close()
    router.close()


class Stream:
    """A driver and its machine's messages."""

    def __init__(self, sessions: tuple[Any, Any], name: str) -> None:
        self.driver = ZenohDriver(sessions[1], SITE.name, name)
        self._publisher = sessions[0].declare_publisher(keys.sensors(SITE.name, name))
        self._wait(True)

    def put(self, payload: bytes) -> None:
        self._publisher.put(payload)

    def read(self) -> Any:
        return self.driver.read(10.0)

    def close(self) -> None:
        self.driver.close()
        self._wait(False)  # else the next stream of the name mistakes this subscriber for its own
        self._publisher.undeclare()

    def _wait(self, known: bool) -> None:
        until(lambda: self._publisher.matching_status.matching == known, f"the router knows of it, {known=}")


@pytest.fixture
def stream(sessions: tuple[Any, Any]) -> Iterator[Stream]:
    stream = Stream(sessions, "loader-1")
    yield stream
    stream.close()


def reading(i: int) -> Reading:
    return Articulation("articulation", START_NS + i, 0.1 * i)


def bundle(counter: int, n: int = 2, machine: str = "loader-1", *, last: bool = False) -> bytes:
    return encode_bundle(SensorBundle(machine, counter, tuple(map(reading, range(1, n + 1))), last))


def test_bundles_come_in_as_readings(stream: Stream) -> None:
    assert stream.driver.read(0.0) == ()
    stream.put(bundle(1))
    assert list(stream.read()) == [reading(1), reading(2)]
    assert stream.driver.counters() == {}


def test_missing_bundles_are_counted_and_a_stream_that_starts_anew_is_no_gap(stream: Stream) -> None:
    for counter in (5, 6, 9, 1, 2, 4):
        stream.put(bundle(counter))
        assert stream.read()
    assert stream.driver.counters() == {"bundles_missing": 3}


def test_malformed_bundles_and_those_of_others_are_counted(stream: Stream) -> None:
    for payload in (b"\xc1nonsense", bundle(1)[:-3], bundle(1, machine="loader-2"), bundle(1)):
        stream.put(payload)
    assert [len(stream.read()) for _ in range(4)] == [0, 0, 0, 2]
    assert stream.driver.counters() == {"refused_bundle_not_msgpack": 2, "refused_bundle_wrong_machine": 1}


def test_implausible_reading_is_refused_and_counted(stream: Stream) -> None:
    readings = (reading(1), Articulation("articulation", START_NS + 2, 99.0))
    stream.put(encode_bundle(SensorBundle("loader-1", 1, readings)))
    assert list(stream.read()) == [reading(1)]
    assert stream.driver.counters() == {"refused_reading_out_of_range": 1}


def test_last_bundle_ends_the_stream(stream: Stream) -> None:
    stream.put(bundle(1, last=True))
    assert len(stream.read()) == 2
    assert stream.read() is None


def test_driver_hears_no_other_machine(sessions: tuple[Any, Any], stream: Stream) -> None:
    other = Stream(sessions, "loader-2")
    other.put(bundle(1, machine="loader-2"))
    assert other.read()
    assert stream.driver.read(0.0) == ()
    other.close()


def test_bundles_beside_a_receiver_give_what_their_table_feeds_at_the_receiver_s_time() -> None:
    """They wait for its first fix; implausible values and foreign readings are counted."""
    late = Articulation("articulation", START_NS + 5 * 10**9, 0.5)
    span = [Torque("torque", START_NS, 7.0), reading(0), Torque("articulation", START_NS, 7.0)]
    feeds = {"articulation": SensorConfig("joint", "articulation")}
    source = BundleSource(Given(span, [late]), feeds, lambda: 10**12)
    pieces = [source.read(0.0), source.read(0.0), [Observed("", "", (), 10**12, START_NS)]]
    assert source.read(0.0) is None
    assert source.counters() == {"given": 1, "refused_reading_wrong_kind": 1}
    sources, readings = Sources({"bundles": Script(pieces)}, TimeBase()), list[Reading]()
    while (piece := sources.read(5.0)) is not None:
        readings += piece
    sources.close()
    assert readings == [Articulation("joint", START_NS, 0.0)]
    assert sources.counters()["stamp_refused"] == 1


# --- the agent around them -------------------------------------------------------------------------------------------


class Given:
    """A driver of given readings."""

    def __init__(self, *spans: list[Reading]) -> None:
        self._spans = list(spans)
        self.closed = False

    def read(self, timeout_s: float) -> list[Reading] | None:
        return self._spans.pop(0) if self._spans else None

    def counters(self) -> dict[str, int]:
        return {"given": 1}

    def problems(self) -> list[str]:
        return []

    def close(self) -> None:
        self.closed = True


def run_agent(session: Any, folder: Path, config: AgentConfig, driver: Given, *, stopped: bool = False) -> Any:
    time_ = Time()
    agent = Agent(session, SITE, VEHICLE, config, Places(folder / "spool.db", folder / "audit.txt"))
    try:
        return agent.run(driver, lambda: stopped and driver.closed, time_.clock, time_.wait), time_
    finally:
        agent.close()


@pytest.mark.slow
@pytest.mark.parametrize(("linger_s", "stopped"), [(3.0, False), (3.0, True)])
def test_agent_lingers_for_the_last_samples_unless_it_is_stopped(
    sessions: tuple[Any, Any], tmp_path: Path, linger_s: float, stopped: bool
) -> None:
    """Without acknowledgement the samples stay in the spool and the report says so."""
    config = AgentConfig(linger_s=linger_s, uplink=UplinkConfig(timeout_s=0.2))
    driver = Given(drive([Leg(4, 0.5), Leg(14)], VEHICLE).readings)
    report, time_ = run_agent(sessions[1], tmp_path, config, driver, stopped=stopped)
    assert driver.closed
    assert report["samples"] > 20
    assert report["spool"]["depth"] == report["samples"]
    assert report["delivered"] is False
    assert sum(time_.waits) == pytest.approx(0.0 if stopped else linger_s, abs=0.06)
    assert report["spool"]["pending"] == 0
    assert len(read_audit(tmp_path / "audit.txt")) == report["samples"]


OUT_AND_BACK = (Leg(4, 0.5), Leg(14), Leg(4, -0.5), Leg(2), Leg(4, -0.5), Leg(14), Leg(4, 0.5), Leg(3))


@pytest.mark.slow
def test_calibration_is_kept_across_restarts(sessions: tuple[Any, Any], tmp_path: Path) -> None:
    """The accelerometer's zero, learnt on a way out and back, serves the next agent.

    Broken files are reported and replaced.
    """
    zero_mps2, made, reports = 0.05, thinned(drive(OUT_AND_BACK, VEHICLE).readings), []
    readings = [replace(r, force_x_mps2=r.force_x_mps2 + zero_mps2) if isinstance(r, Imu) else r for r in made]
    (tmp_path / "c.json").write_text("not a calibration")
    for spans in ([readings], [readings[:500]]):
        time_, places = Time(), Places(tmp_path / "spool.db", calibration=tmp_path / "c.json")
        agent = Agent(sessions[1], SITE, VEHICLE, AgentConfig(linger_s=0.0), places)
        try:
            assert ("c.json" in agent.report(Given())["calibration_problem"]) is not bool(reports)
            reports.append(agent.run(Given(*spans), lambda: False, time_.clock, time_.wait))
        finally:
            agent.close()
    before, after = (report["pipeline"]["ground"]["calibration"] for report in reports)
    assert before["passages"] > 20
    assert after["passages"] == before["passages"]
    assert after["zero"] == pytest.approx(-zero_mps2 / GRAVITY_MPS2, abs=5e-4)
    assert reports[0]["calibration_problem"] == ""
