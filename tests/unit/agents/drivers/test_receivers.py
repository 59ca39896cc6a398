from __future__ import annotations

import errno
import os
import pty
import random
import socket
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.drivers import Observed
from agents.drivers.line import Line
from agents.drivers.receiver import NO_FIX_S, RETRY_S, SILENT_S, TRY_S, ReceiverSource
from agents.drivers.sources import Sources
from agents.drivers.tables import DriverConfig, open_sources
from agents.drivers.time_base import TimeBase
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import joined
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Reading
from sim.receivers.nmea import sentence as nmea
from sim.receivers.receiver import SimulatedReceiver, Wiring
from tests.patience import until
from tests.unit.agents.drivers.frames import GGA, RMC, TEN, TPV, Script, esf, no_bundles, pvt, report, spoiled
from tests.unit.agents.drivers.test_formats import SENSORS
from tests.unit.agents.drives import SITE, START_NS, VEHICLE, Leg, drive

MACHINE = MachineConfig("loader-1", sensors=tuple(SENSORS.values()))
GPSD_MACHINE = MachineConfig(
    "loader-1", sensors=(SensorConfig("gps-1", "gps", std={"position": 2.0}), SENSORS["velocity"])
)


class Clock:
    """Monotonic clock moved by waiting."""

    def __init__(self) -> None:
        self.now_ns = 10**12

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Device:
    """A serial device on a pseudo-terminal; its port is a link that can vanish."""

    def __init__(self, folder: Path) -> None:
        self.port = folder / "ttyACM0"
        self.plug_in()

    def plug_in(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port.symlink_to(os.ttyname(slave))
        self._slave = slave

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def baud(self) -> int:
        """As set by the other side."""
        return int(termios.tcgetattr(self._slave)[5])

    def unplug(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        self.port.unlink()


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    made = Device(tmp_path)
    yield made
    if made.port.exists():
        made.unplug()


@contextmanager
def receiver(address: object, clock: Clock, format_: str = "nmea", baud: int = 0) -> Iterator[ReceiverSource]:
    made = ReceiverSource(str(address), baud, format_, Line(format_, SENSORS), lambda: clock.now_ns, clock.wait)
    with closing(made):
        yield made


def listened(source: ReceiverSource, send: Callable[[], object], n: int = 1) -> list[Observed]:
    """The first n values or more, sent until they are in."""
    values: list[Observed] = []

    def more() -> bool:
        send()
        values.extend(value for value in source.read(0.05) or () if value.sensor)
        return len(values) >= n

    until(more, "values of a receiver")
    return values


# --- transports ------------------------------------------------------------------------------------------------------


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


@contextmanager
def sender(stream: bytes, greeted: bytes = b"") -> Iterator[str]:
    """A server of one stream: sends once greeted, then hangs up."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            link, _ = server.accept()
            with link:
                assert not greeted or link.recv(len(greeted)) == greeted
                link.sendall(stream)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        thread.join()


def read_all(config: DriverConfig, machine: MachineConfig, n: int) -> list[Reading]:
    """One table's readings, as an agent reads them."""
    readings: list[Reading] = []
    with closing(open_sources([config], machine, lambda: (1, 1), no_bundles)) as sources:
        until(lambda: readings.extend(sources.read(0.05) or ()) or len(readings) >= n, "readings")
    return readings


def epochs(n: int) -> list[bytes]:
    """RMC and GGA epochs within one second, the longest accepted hold-up."""
    times = [f"{101527 + i / n:010.3f}" for i in range(n)]
    return [nmea(text.replace("101527.20", time)) for time in times for text in (RMC, GGA)]


FEEDS = {"fix": "gps-1", "velocity": "doppler"}


@pytest.mark.parametrize("kind", ["nmea", "ubx", "gpsd"])
def test_every_whole_frame_comes_over_tcp_as_a_reading(kind: str) -> None:
    frames = {
        "nmea": epochs(200),
        "ubx": [pvt(nano=i * 5_000_000) for i in range(200)],
        "gpsd": [report(TPV | {"time": f"2026-11-26T10:15:27.{5 * i:03}Z"}) for i in range(200)],
    }[kind]
    stream, whole = spoiled(frames)
    greeting = b'?WATCH={"enable":true,"json":true};\n' if kind == "gpsd" else b""
    machine = GPSD_MACHINE if kind == "gpsd" else MACHINE
    with sender(stream, greeting) as address:
        readings = read_all(DriverConfig(kind, address, feeds=FEEDS), machine, whole - 20)
    fixes = [reading for reading in readings if isinstance(reading, Gps)]
    assert {round(fix.lat_deg, 5) for fix in fixes} == {49.01012}
    assert len({fix.stamp_ns for fix in fixes}) == len(fixes)


def test_datagrams_are_read(tmp_path: Path) -> None:
    port, clock = free_port(socket.SOCK_DGRAM), Clock()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out, receiver(f"udp://127.0.0.1:{port}", clock) as source:
        source.read(0.0)
        values = listened(source, lambda: out.sendto(nmea(RMC) + nmea(GGA), ("127.0.0.1", port)), 2)
    assert [value.sensor for value in values[:2]] == ["doppler", "gps-1"]


def test_a_file_is_read_to_its_end_as_fast_as_the_agent_is(tmp_path: Path) -> None:
    path = tmp_path / "drive.nmea"
    path.write_bytes(b"".join(epochs(500)))
    readings: list[Reading] = []
    with closing(
        open_sources([DriverConfig("nmea", str(path), feeds=FEEDS)], MACHINE, lambda: (1, 1), no_bundles)
    ) as sources:
        while (piece := sources.read(1.0)) is not None:
            readings += piece
    assert len(readings) == 2 * 500
    assert [r.stamp_ns for r in readings] == sorted(r.stamp_ns for r in readings)
    path.write_bytes(pvt() * 3)
    with receiver(path, Clock()) as source:
        until(lambda: source.read(0.0) is None, "the end of the file")
        assert source.problems() == [f"{path}: no frame of NMEA is in this file"]


# --- lost and restored ports -----------------------------------------------------------------------------------------


def test_a_receiver_that_is_unplugged_is_read_again_within_two_seconds_of_its_return(device: Device) -> None:
    clock = Clock()
    with receiver(device.port, clock) as source:
        assert listened(source, lambda: device.send(nmea(RMC)))
        device.unplug()
        until(lambda: source.read(0.0) == () and source.problems(), "the link to break")
        assert "plug it in again" in source.problems()[0]
        for _ in range(5):
            source.read(1.0)
        assert "no such port" in source.problems()[0]
        device.plug_in()
        back_ns = clock.now_ns
        assert listened(source, lambda: device.send(nmea(RMC)))
        assert clock.now_ns - back_ns <= 2e9
        assert (source.problems(), source.counters()["link_broke"]) == ([], 1)
    assert RETRY_S < 2


def test_a_peer_that_hangs_up_or_falls_silent_is_called_again() -> None:
    clock = Clock()
    server = socket.create_server(("127.0.0.1", 0))
    with server, receiver(f"tcp://127.0.0.1:{server.getsockname()[1]}", clock) as source:
        source.read(0.0)
        server.accept()[0].close()
        until(lambda: source.read(0.0) == () and source.problems(), "the link to break")
        clock.wait(RETRY_S)
        source.read(0.0)
        silent, _ = server.accept()
        clock.wait(SILENT_S + 1)
        source.read(0.0)
        silent.close()
        assert "nothing comes" in source.problems()[0]
        clock.wait(RETRY_S)
        source.read(0.0)
        server.accept()[0].close()


def test_a_baud_is_found_and_a_wrong_one_is_named(device: Device) -> None:
    clock, draw = Clock(), random.Random(1)

    def speak() -> None:
        is_right = device.baud() == termios.B38400
        device.send(nmea(RMC) + nmea(GGA) if is_right else draw.randbytes(40).replace(b"$", b""))
        clock.wait(TRY_S / 2)

    with receiver(device.port, clock, baud=9600) as source:
        source.read(0.0)
        assert listened(source, speak, 2)
        assert source.problems() == [f"{device.port}: it sends at 38400 baud: say `baud = 38400`"]
        assert source.counters()["bauds_tried"] == 2
    with receiver(device.port, clock) as source:
        source.read(0.0)
        assert listened(source, speak, 2)
        assert source.problems() == []


# --- set-up errors, one sentence each --------------------------------------------------------------------------------


def problem(source: ReceiverSource, clock: Clock, device: Device, data: bytes, step_s: float, n: int) -> str:
    for _ in range(n):
        source.read(0.0)
        device.send(data)
        clock.wait(step_s)
        source.read(1.0)
    (sentence,) = source.problems()
    return sentence


@pytest.mark.parametrize(
    ("data", "step_s", "n", "sentence"),
    [
        (pvt(), 0.1, 12, 'it sends UBX, and nothing of NMEA: say `kind = "ubx"`, or set it to send NMEA'),
        (nmea("GNGGA,,,,,,0,03,99.99,,,,,,"), 1.0, NO_FIX_S + 2, "no fix, 3 satellites: its antenna needs open sky"),
        (nmea(RMC), 1.0, NO_FIX_S + 2, "it sends no positions: switch on GGA and RMC, or NAV-PVT"),
        (nmea(GGA), 1.0, NO_FIX_S + 2, "it sends positions without a date: switch on RMC, or ZDA"),
        (b"", SILENT_S, 2, "nothing comes: is it powered, wired, and set to send here?"),
        (b"\x00\xff\xd3" * 9, 1.0, 4, "no frame of NMEA or UBX at 115200 baud: trying 9600"),
    ],
)
def test_what_hinders_a_receiver_is_said_in_a_sentence(
    data: bytes, step_s: float, n: float, sentence: str, device: Device
) -> None:
    clock = Clock()
    with receiver(device.port, clock) as source:
        assert problem(source, clock, device, data, step_s, int(n)) == f"{device.port}: {sentence}"


def test_a_port_that_cannot_be_opened_says_why(tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    with receiver(tmp_path / "ttyACM7", clock) as source:
        assert source.read(0.0) == ()
        assert f"{tmp_path}/ttyACM7: no such port; there " in source.problems()[0]
    with receiver(device.port, clock) as first, receiver(device.port, clock) as second:
        first.read(0.0)
        second.read(0.0)
        assert "another program has this port" in second.problems()[0]
    with receiver(f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}", clock) as source:
        source.read(0.0)
        assert "nobody listens there" in source.problems()[0]

    def forbid(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("agents.drivers.receiver.open_transport", forbid)  # tests may run as root
    with receiver("/dev/ttyUSB0", clock) as source:
        source.read(0.0)
        assert source.problems() == [
            "/dev/ttyUSB0: no permission: add this user to the group of the port (dialout), and log in again"
        ]


# --- one time base ---------------------------------------------------------------------------------------------------


def played(**sources: Sequence[Sequence[Observed]]) -> tuple[list[Reading], Sources]:
    readings: list[Reading] = []
    driver = Sources({name: Script(pieces) for name, pieces in sources.items()}, TimeBase())
    while (piece := driver.read(5.0)) is not None:
        readings += piece
    driver.close()
    return readings, driver


def rate(host_ns: int) -> Observed:
    return Observed("imu-1", "imu", (0.0, 0.0, 0.0, 0.0, 0.0, 9.8), host_ns)


def time_at(host_ns: int, utc_ns: int) -> Observed:
    return Observed("", "", (), host_ns, utc_ns)


def test_a_driver_that_raises_is_named_and_the_others_go_on() -> None:
    broken = Script([])
    broken.read = lambda timeout_s: [][0]  # type: ignore[method-assign]
    driver = Sources({"a": broken, "b": Script([[time_at(10**9, TEN * 10**9)], [rate(10**9)]])}, TimeBase())
    readings: list[Reading] = []
    until(lambda: (piece := driver.read(0.1)) is None or readings.extend(piece), "the end")
    assert len(readings) == 1
    assert "a: its driver ended (IndexError" in driver.problems()[0]
    driver.close()


def test_readings_wait_for_utc_and_have_the_host_s_monotonic_time_then() -> None:
    waiting = [[rate(5 * 10**9 + i * 10**7)] for i in range(100)]
    readings, _ = played(line=[*waiting, [time_at(6 * 10**9, TEN * 10**9)], [rate(7 * 10**9)]])
    first_ns = (TEN - 1) * 10**9
    assert [r.stamp_ns for r in readings] == [*(first_ns + i * 10**7 for i in range(100)), (TEN + 1) * 10**9]
    readings, driver = played(line=waiting)
    assert readings == []
    assert "readings wait for UTC" in driver.problems()[0]


def test_the_least_delayed_message_ties_the_clocks() -> None:
    draw, host_ns = random.Random(5), 10**12
    pieces = []
    for i in range(200):
        late_ns = round(draw.expovariate(1 / 40e6)) + 20_000_000
        pieces.append([time_at(host_ns + i * 10**8 + late_ns, TEN * 10**9 + i * 10**8), rate(host_ns + i * 10**8)])
    readings, _ = played(line=pieces)
    off_ns = readings[-1].stamp_ns - (TEN * 10**9 + 199 * 10**8)
    assert -25_000_000 < off_ns < -20_000_000


def test_a_receiver_whose_time_is_another_one_is_left_out_and_named() -> None:
    fix = SENSORS["fix"].name
    right = [[time_at(i * 10**9, (TEN + i) * 10**9)] for i in range(1, 9)]
    values = (49.0, 8.4, 0.0, 1.0, 1.0, 1.0)
    ahead = [[time_at(9 * 10**9, (TEN + 27) * 10**9), Observed(fix, "gps", values, 9 * 10**9, (TEN + 27) * 10**9)]]
    base = TimeBase()
    driver = Sources({"a": Script([*right, []]), "b": Script([])}, base)
    for value in (*(v for piece in right for v in piece), *()):
        base.take("a", value.utc_ns, value.host_ns)
    base.take("b", ahead[0][0].utc_ns, ahead[0][0].host_ns)
    assert not base.believes(ahead[0][1].utc_ns, ahead[0][1].host_ns)
    assert driver.problems() == ["b: its time is 18 s ahead of the others', so it is left out"]
    driver.close()


def test_a_receiver_whose_clock_is_set_counts_again_and_a_line_that_was_held_up_sets_nothing() -> None:
    base = TimeBase()
    for i in range(100):
        base.take("a", (TEN + i) * 10**9, i * 10**9)
    for i in range(100, 130):  # 30 messages at once
        base.take("a", (TEN + i) * 10**9, 130 * 10**9)
    assert base.utc_ns(130 * 10**9) == (TEN + 130) * 10**9
    for i in range(131, 136):
        base.take("a", (TEN + i + 18) * 10**9, i * 10**9)
    assert base.utc_ns(140 * 10**9) == (TEN + 158) * 10**9
    assert base.counters["clock_set"] == 1


def test_sensors_ticks_free_their_readings_of_what_delays_single_frames() -> None:
    line, draw = Line("ubx", {"imu": SENSORS["imu"]}), random.Random(2)
    stamps = []
    for i in range(300):
        frame = esf(7000 + 10 * i, *((kind, 1) for kind in (14, 13, 5, 16, 17, 18)))
        stamps += [v.host_ns - i * 10**7 for v in line.feed(frame, 10**12 + i * 10**7 + draw.randrange(5 * 10**6))]
    assert len(stamps) == 300
    assert max(stamps[100:]) - min(stamps[100:]) < 200_000


# --- a drive ---------------------------------------------------------------------------------------------------------

LEGS = [Leg(4, 0.6), Leg(15, 0.0, 0.12), Leg(12)]
SEEN = replace(VEHICLE, sensors=tuple(s for s in VEHICLE.sensors if s.kind != "torque"))
LATE_NS = {"gps": 60_000_000, "encoder": 8_000_000, "imu": 5_000_000}  # message latency [ns]


@pytest.mark.slow
def test_a_drive_through_bytes_is_the_same_drive() -> None:
    """Whatever the latencies and the host's clock."""
    made, (imu, wheels, gps) = drive(LEGS, SEEN), SEEN.sensors
    feeds = {"fix": gps, "imu": imu, "wheels": wheels}
    line, spoken = Line("ubx", feeds), SimulatedReceiver(Wiring("gps-1", "ubx", 10**9, feeds))
    frames = [spoken.speak([reading]) for reading in made.readings]
    draw = random.Random(7)
    arrived = sorted(
        (r.stamp_ns - START_NS + LATE_NS[r.kind] + draw.randrange(3_000_000), i) for i, r in enumerate(made.readings)
    )
    pieces = [line.feed(frames[i], 5 * 10**12 + came_ns) for came_ns, i in arrived]
    readings, _ = played(line=pieces)
    assert len(readings) > 0.99 * len(made.readings)
    direct, through = (Pipeline(SITE, SEEN, PipelineConfig()) for _ in range(2))
    samples = [joined([p.step(r), p.finish()]).final for p, r in ((direct, made.readings), (through, readings))]
    off_m = [abs(made.off_m(pipeline.pose)) for pipeline in (direct, through) if pipeline.pose]
    assert len(off_m) == 2
    assert off_m[1] < off_m[0] + 0.05
    assert len(samples[1]) == pytest.approx(len(samples[0]), rel=0.1)
    assert np.abs(samples[1]["grade_e"]).max() < 0.02
