"""A machine's bus: signals against an independent DBC, streams, senders, buses that come and go, recordings."""

from __future__ import annotations

import math
import random
import socket
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import can
import cantools
import pytest

from agents.drivers import Observed
from agents.drivers.can.buses import BUS_OFF, Bus, CanFrame, read_recording
from agents.drivers.can.config import SignalConfig, all_signals
from agents.drivers.can.line import CanLine
from agents.drivers.can.pgns import SIGNALS
from agents.drivers.can.signals import EXTENDED, group_of
from agents.drivers.can.source import CanSource, RecordingSource
from agents.drivers.tables import DriverConfig, open_sources
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import Engine
from tests.paths import SHARED_DATA
from tests.patience import until
from tests.unit.agents.drivers.frames import no_bundles

TEN_NS = 1_795_688_127 * 10**9
SENSORS = {
    "engine": SensorConfig("engine", "engine"),
    "losses": SensorConfig("losses", "engine_losses"),
    "gearbox": SensorConfig("gearbox", "driveline"),
    "clutch": SensorConfig("clutch", "driveline"),
    "speed": SensorConfig("speed", "odometry", measures=("speed",)),
    "rear_speed": SensorConfig("rear", "odometry", measures=("speed",)),
    "brake_switch": SensorConfig("brake", "brake"),
    "brake_pedal": SensorConfig("pedal", "brake"),
    "ebs_switch": SensorConfig("ebs", "brake"),
    "retarder": SensorConfig("retarder", "retarder"),
    "cargo": SensorConfig("cargo", "payload"),
    "turn_rate": SensorConfig("turns", "odometry", measures=("rate",)),
    "fix": SensorConfig("gps-1", "gps", std={"position": 2.0}),
    "velocity": SensorConfig("doppler", "gps_velocity", std={"velocity": 0.1}),
}
# An independent description of the same parameter groups, by the conventions of a DBC (start bit, length, scale).
DBC = """VERSION ""
BU_: X
BO_ 2364540158 EEC1: 8 X
 SG_ Torque : 16|8@1+ (1,-125) [-125|125] "%" X
 SG_ Speed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" X
BO_ 2566844926 CCVS1: 8 X
 SG_ Wheels : 8|16@1+ (0.00390625,0) [0|250.996] "km/h" X
 SG_ Brake : 28|2@1+ (1,0) [0|3] "" X
 SG_ Clutch : 30|2@1+ (1,0) [0|3] "" X
BO_ 2364539646 ETC1: 8 X
 SG_ Engaged : 0|2@1+ (1,0) [0|3] "" X
 SG_ Locked : 2|2@1+ (1,0) [0|3] "" X
 SG_ Shift : 4|2@1+ (1,0) [0|3] "" X
BO_ 2566845182 LFE1: 8 X
 SG_ Rate : 0|16@1+ (0.05,0) [0|3212.75] "L/h" X
BO_ 291 Scale: 8 X
 SG_ Mux M : 0|8@1+ (1,0) [0|255] "" X
 SG_ Load m1 : 15|16@0+ (0.1,0) [0|6553] "t" X
"""
RPM, KMPH = math.pi / 30, 1 / 3.6
PAIRS = {  # signal of the table, signal of the DBC, unit
    "engine_torque": ("EEC1", "Torque", 0.01),
    "engine_speed": ("EEC1", "Speed", RPM),
    "vehicle_speed": ("CCVS1", "Wheels", KMPH),
    "brake_switch": ("CCVS1", "Brake", 1.0),
    "clutch_switch": ("CCVS1", "Clutch", 1.0),
    "driveline_engaged": ("ETC1", "Engaged", 1.0),
    "converter_locked": ("ETC1", "Locked", 1.0),
    "gear_shifting": ("ETC1", "Shift", 1.0),
    "fuel_rate": ("LFE1", "Rate", 1.0),
}


def frame(pgn: int, sender: int = 0, **signals: float) -> tuple[int, bytes]:
    """Identifier and data; what is not given is not available."""
    raw = (1 << 64) - 1
    for name, value in signals.items():
        s = SIGNALS[name]
        assert s.group == EXTENDED | pgn
        raw &= ~(((1 << s.bits) - 1) << s.start)
        raw |= (round((value - s.offset) / s.scale) & ((1 << s.bits) - 1)) << s.start
    return 3 << 26 | pgn << 8 | sender, raw.to_bytes(8, "little")


EEC1 = frame(61444, engine_torque=0.37, engine_speed=157.0)


def line(*streams: str, **feeds: SensorConfig) -> CanLine:
    return CanLine({**{name: SENSORS[name] for name in streams}, **feeds}, SIGNALS)


def test_the_table_reads_what_an_independent_dbc_reads() -> None:
    database = cantools.database.load_string(DBC, "dbc")
    draw = random.Random(4)
    for _ in range(500):
        data = draw.randbytes(8)
        for name, (message, label, unit) in PAIRS.items():
            value = SIGNALS[name].value(data)
            decoded = database.get_message_by_name(message).decode(data, decode_choices=False)
            if value is not None:
                assert value == pytest.approx(float(decoded[label]) * unit)


@pytest.mark.parametrize(("raw", "value"), [(0xFA, 1.25), (0xFB, None), (0xFE, None), (0xFF, None), (0x7D, 0.0)])
def test_errors_and_not_available_are_no_values(raw: int, value: float | None) -> None:
    assert SIGNALS["engine_torque"].value(bytes((0, 0, raw))) == (None if value is None else pytest.approx(value))
    assert SIGNALS["engine_speed"].value(bytes((0, 0, 0, 0, 0xFB))) is None
    assert SIGNALS["brake_switch"].value(bytes((0, 0, 0, 0b10_0000))) is None
    assert SIGNALS["latitude"].value(b"\xff\xff\xff\x7f") is None
    assert SIGNALS["latitude"].value(b"\xff\xff\xff") is None  # cut


@pytest.mark.parametrize(
    ("stream", "frames", "values"),
    [
        ("engine", [EEC1], (0.37, 157.0)),
        ("losses", [frame(65247, engine_friction=0.09, engine_parasitic=0.03)], (0.12,)),
        ("losses", [frame(65247, engine_friction=0.09)], (0.09,)),
        ("gearbox", [frame(61442, 3, driveline_engaged=1, converter_locked=0, gear_shifting=0)], (1, 0, 0)),
        ("gearbox", [frame(61442, 3, gear_shifting=1)], (1, 1, 1)),
        ("clutch", [frame(65265, clutch_switch=1)], (0, 1, 0)),
        ("speed", [frame(65265, vehicle_speed=5.0)], (5.0, 0, 0)),
        ("speed", [frame(61445, 3, gear=-1), frame(65265, vehicle_speed=5.0)], (-5.0, 0, 0)),
        ("rear_speed", [frame(65134, 11, rear_left_speed=4.0, rear_right_speed=5.0)], (4.5, 0, 0)),
        ("brake_switch", [frame(65265, brake_switch=1)], (1,)),
        ("brake_pedal", [frame(61441, 11, brake_pedal=0.4)], (0.4,)),
        ("ebs_switch", [frame(61441, 11, ebs_switch=0)], (0,)),
        ("retarder", [frame(61440, 16, retarder_torque=-0.6)], (0.6,)),
        ("cargo", [frame(65258, cargo_mass=12_000)], (12_000,)),
        ("turn_rate", [frame(127251, 35, turn_rate=-0.25)], (0, 0, -0.25)),
        ("fix", [frame(129025, 35, latitude=-33.1234567, longitude=151.5)], (-33.1234567, 151.5, 0, 4, 4, 4)),
        ("velocity", [frame(129026, 35, course_is_magnetic=0, course=math.pi / 2, ground_speed=3)], (3, 0, 0.01, 0.01)),
    ],
)
def test_frames_of_any_sender_feed_their_stream(
    stream: str, frames: list[tuple[int, bytes]], values: tuple[float, ...]
) -> None:
    bus = line(stream)
    observed = [value for f in frames for value in bus.take(*f, TEN_NS)]
    assert [o.kind for o in observed] == [SENSORS[stream].kind]
    assert observed[0].values == pytest.approx(values, abs=0.01)
    assert observed[0].host_ns == TEN_NS


def test_loads_of_all_axles_less_the_empty_machine_are_its_payload() -> None:
    """Axle by axle. A location that is none spoils its round alone; an axle that falls silent leaves no payload."""
    bus = CanLine({"axles": SensorConfig("load", "payload")}, SIGNALS, mass_kg=22_000.0)
    empty, loaded = {0x00: 9e3, 0x10: 13e3}, {0x00: 15e3, 0x10: 26e3}
    seen = []
    for loads in (empty, empty, loaded, {**loaded, 0x55: 3e4}, loaded, {0x00: 15e3}, {0x00: 15e3}, {0x00: 15e3}):
        for location, load in loads.items():
            identifier, data = frame(65258, axle_location=location, axle_load=load)
            seen += [value.values[0] for value in bus.take(identifier, data, TEN_NS)]
    assert seen == [0.0, 19_000.0, 19_000.0]


def test_a_magnetic_course_is_no_velocity() -> None:
    assert line("velocity").take(*frame(129026, course_is_magnetic=1, course=1, ground_speed=3), TEN_NS) == []


def test_of_two_senders_of_a_group_the_first_counts_until_it_falls_silent_and_one_sentence_says_so() -> None:
    bus = line("engine")
    engines = [(i, frame(61444, i % 2, engine_torque=0.1 * (i % 2), engine_speed=100)) for i in range(20)]
    observed = [o for i, f in engines for o in bus.take(*f, TEN_NS + i * 10**8)]
    assert {o.values[0] for o in observed} == {0.0}
    first, *others = bus.problems(TEN_NS + 2 * 10**9)
    assert first == (
        'EEC1 (PGN 61444) comes from 0x00 and 0x01: 0x00 counts; `feeds` can name another, as "0x01:STREAM"'
    )
    assert others == []
    assert bus.take(*engines[1][1], TEN_NS + 9 * 10**9)[0].values[0] == pytest.approx(0.1)
    assert bus.problems(TEN_NS + 9 * 10**9) == []


def test_senders_that_are_named_feed_a_sensor_each() -> None:
    bus = line(**{"0x0f:retarder": SENSORS["retarder"], "0x10:retarder": SENSORS["brake_pedal"]})
    frames = (frame(61440, sender, retarder_torque=-0.02 * sender) for sender in (0x0F, 0x10, 0x29))
    assert [o.sensor for f in frames for o in bus.take(*f, TEN_NS)] == ["retarder", "pedal"]
    assert bus.problems(TEN_NS) == []


def test_a_stream_without_values_is_named_and_why() -> None:
    bus, later_ns = line("gearbox", "brake_switch"), TEN_NS + 6 * 10**9
    for i in range(60):
        bus.take(*frame(65265, vehicle_speed=3.0), TEN_NS + i * 10**8)
    assert sorted(bus.problems(later_ns)) == [
        "CCVS1 (PGN 65265) comes, but what brake needs is marked as not available",
        "no ETC1 (PGN 61442) with a value comes: gearbox is not fed; is it the right bus?",
    ]


def test_signals_of_the_configuration_are_streams_or_take_the_place_of_built_in_ones(tmp_path: Path) -> None:
    path = tmp_path / "machine.dbc"
    path.write_text(DBC)
    signals = all_signals(
        {
            "load": SignalConfig(dbc="Scale.Load", scale=1000.0),
            "joint": SignalConfig(id=0x124, start=8, bits=16, scale=1e-4, signed=True),
            "engine_torque": SignalConfig(pgn=65_300, start=0, bits=8, scale=0.005),
        },
        str(path),
    )
    bus = CanLine(
        {"load": SENSORS["cargo"], "joint": SensorConfig("joint", "articulation"), "engine": SENSORS["engine"]}, signals
    )
    load = bus.take(0x123, bytes((1, 0x0C, 0x00, 0, 0, 0, 0, 0)), TEN_NS, is_extended=False)
    assert [o.values for o in load] == [pytest.approx((0x0C00 * 0.1 * 1000,))]
    assert bus.take(0x123, bytes(8), TEN_NS, is_extended=False) == []  # another value of the multiplexer
    angle = bus.take(0x124, bytes((0, 0x18, 0xFC)), TEN_NS, is_extended=False)
    assert [o.values for o in angle] == [pytest.approx((-0.1,))]
    bus.take(*EEC1, TEN_NS)
    assert bus.take(3 << 26 | 65_300 << 8, bytes((80, 0)), TEN_NS)[0].values == pytest.approx((0.4, 157.0), abs=0.01)


@pytest.mark.parametrize(
    ("signal", "problem"),
    [
        ({"dbc": "EEC9.Torque"}, "the DBC has no 'EEC9.Torque'"),
        ({"dbc": "EEC1.Torque", "bits": 8}, "it states pgn, id, start, bits and signed"),
        ({"pgn": 65300}, "0 bits from bit 0 are not within a frame"),
        ({"bits": 8}, "give one of them"),
        ({"bits": 8, "id": 4096}, "give one of them"),
    ],
)
def test_a_signal_that_is_wrong_is_refused(tmp_path: Path, signal: dict[str, object], problem: str) -> None:
    path = tmp_path / "machine.dbc"
    path.write_text(DBC)
    with pytest.raises(ValueError, match=problem):
        all_signals({"load": SignalConfig(**signal)}, str(path))


def test_a_dbc_that_is_none_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "machine.dbc"
    for text in ("BO_ nonsense", "\x00\xff"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"machine\.dbc"):
            all_signals({}, str(path))


# --- buses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "options"),
    [
        ("virtual://test-can", {"interface": "virtual", "channel": "test-can"}),
        (
            "udp_multicast://239.74.163.77:{port}",
            {"interface": "udp_multicast", "channel": "239.74.163.77", "hop_limit": 0},
        ),
    ],
    ids=["virtual", "udp_multicast"],
)
def test_frames_on_a_bus_become_readings(address: str, options: dict[str, object]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    address = address.format(port=port)
    options |= {"port": port} if "udp" in address else {}
    identifier, data = EEC1
    observed: list[Observed] = []
    with closing(CanSource(address, line("engine"))) as source, can.Bus(**options) as sender:

        def exchanged() -> bool:
            sender.send(can.Message(arbitration_id=identifier, is_extended_id=True, data=data))
            sender.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\1"))
            observed.extend(source.read(0.2) or ())
            return len(observed) >= 3

        source.read(0.01)  # opens it
        until(exchanged, "readings of both buses")
    assert {o.values for o in observed} == {observed[0].values}
    assert observed[0].values == pytest.approx((0.37, 157.0), abs=0.01)
    assert 0 <= time.monotonic_ns() - observed[-1].host_ns < 60 * 10**9
    assert source.counters()["frames_can"] >= 3


class Script:
    """A bus of which each read is scripted: frames, or an error."""

    def __init__(self, *reads: list[CanFrame] | OSError) -> None:
        self.reads, self.errors, self.is_off = list(reads), 0, False

    def read(self, timeout_s: float) -> list[CanFrame]:
        step = self.reads.pop(0) if self.reads else []
        if isinstance(step, OSError):
            raise step
        return step

    def close(self) -> None:
        pass


def test_a_bus_that_is_silent_off_pulled_and_back_says_so_in_one_sentence_each() -> None:
    now_ns = [10**12]
    good = [CanFrame(EEC1[0], True, EEC1[1], time.time())]
    buses: list[Script | OSError] = [
        OSError(19, "No such device"),
        Script(good, [], [], [], OSError(100, "Network is down")),
        Script(good, good),
    ]

    def opened(_: str) -> Script:
        bus = buses.pop(0)
        if isinstance(bus, OSError):
            raise bus
        opens.append(bus)
        return bus

    opens: list[Script] = []
    source = CanSource("can7", line("engine"), opened, lambda: now_ns[0], lambda s: None)

    def after(seconds: float) -> list[str]:
        now_ns[0] += round(seconds * 1e9)
        source.read(0.1)
        return list(source.problems())

    assert after(0) == ["can7: no such bus: plug the adapter in, then `ip link set can7 up type can bitrate 250000`"]
    assert after(0.5) == after(0)  # not yet tried again
    assert after(1.1) == []
    assert after(6) == ["can7: the bus is silent: is the ignition on, the cable in, the bit rate right?"]
    opens[0].is_off = True
    assert "can7: bus off" in after(1)[0]
    opens[0].is_off = False
    after(0.1)
    assert after(0.1) == ["can7: the link broke (Network is down): plug it in again"]
    assert after(1.1) == []
    assert source.counters()["link_broke"] == 1
    source.close()


def test_an_error_frame_tells_of_a_controller_that_left_the_bus_until_a_frame_comes() -> None:
    with closing(Bus("virtual://test-off")) as bus, can.Bus(interface="virtual", channel="test-off") as sender:
        sender.send(can.Message(arbitration_id=BUS_OFF, is_error_frame=True, data=bytes(8)))
        assert bus.read(5.0) == []
        assert (bus.errors, bus.is_off) == (1, True)
        sender.send(can.Message(arbitration_id=EEC1[0], data=EEC1[1]))
        assert len(bus.read(5.0)) == 1
        assert not bus.is_off


# --- recordings ------------------------------------------------------------------------------------------------------

RECORDINGS = SHARED_DATA / "recordings"
recorded = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the recordings are not here")


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "trc"])
def test_recordings_of_any_form_are_read_with_their_stamps(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive.{suffix}"
    with can.Logger(path) as writer:
        for i in range(50):
            message = can.Message(timestamp=TEN_NS * 1e-9 + 0.02 * i, arbitration_id=EEC1[0], data=EEC1[1])
            writer.on_message_received(message)
    frames = list(read_recording(str(path)))
    assert [(f.identifier, f.data) for f in frames] == [EEC1] * 50
    assert frames[-1].utc_s - frames[0].utc_s == pytest.approx(0.98, abs=0.002)


def test_a_recording_feeds_an_agent_with_its_own_time(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    with can.Logger(path) as writer:
        for i in range(50):
            writer.on_message_received(
                can.Message(timestamp=TEN_NS * 1e-9 + 0.02 * i, arbitration_id=EEC1[0], data=EEC1[1])
            )
    machine = MachineConfig("truck-1", powertrain=PowertrainConfig(2000.0), sensors=(SENSORS["engine"],))
    driver = DriverConfig("can", str(path), feeds={"engine": "engine"})
    readings = []
    with closing(open_sources([driver], machine, lambda: (1, 1), no_bundles)) as sources:
        while (piece := sources.read(10.0)) is not None:
            readings += piece
    assert len(readings) == 50
    assert all(isinstance(reading, Engine) for reading in readings)
    assert abs(readings[-1].stamp_ns - TEN_NS - 980_000_000) < 1_000_000


def test_a_recording_that_breaks_off_is_read_up_to_there_and_named(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    path.write_text(f"(1795688127.000000) can0 {EEC1[0]:08X}#{EEC1[1].hex()}\n(17956")
    source = RecordingSource(str(path), line("engine"))
    pieces = []
    while (piece := source.read(1.0)) is not None:
        pieces += piece
    assert [o.sensor for o in pieces] == ["", "engine"]
    assert "cannot be read further" in source.problems()[0]


@recorded
def test_the_recording_of_a_truck_agrees_with_its_dbc() -> None:
    database = cantools.database.load_file(RECORDINGS / "can_j1939_demo.dbc")
    checked = 0
    for f in read_recording(str(RECORDINGS / "can_j1939_truck.candump")):
        for message in database.messages:
            if group_of(message.frame_id, is_extended=True) != group_of(f.identifier, is_extended=True):
                continue
            decoded = message.decode(f.data)
            for label, name, unit in (
                ("EngineSpeed", "engine_speed", RPM),
                ("WheelBasedVehicleSpeed", "vehicle_speed", KMPH),
            ):
                if label in decoded and (value := SIGNALS[name].value(f.data)) is not None:
                    assert value == pytest.approx(float(decoded[label]) * unit)
                    checked += 1
    assert checked > 500


@recorded
def test_the_recording_of_a_boat_s_bus_has_places_and_turns() -> None:
    bus = line("fix", "velocity", "turn_rate")
    observed = [
        o for f in read_recording(str(RECORDINGS / "can_n2k_60s.candump")) for o in bus.take(f.identifier, f.data, 1)
    ]
    assert sum(o.kind == "gps" for o in observed) == 300
    places = [o.values[:2] for o in observed if o.kind == "gps"]
    assert all(math.dist(a, b) < 1e-4 for a, b in pairwise(places))
    assert max(abs(o.values[2]) for o in observed if o.kind == "odometry") < 0.2
