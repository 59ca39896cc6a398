"""A laptop's folder: made from what was heard, parsed by agent and server, checked in sentences."""

from __future__ import annotations

import json
import re
import socket
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from agents.delivery.spool import Spool, SpoolConfig
from sim.receivers.nmea import sentence as nmea
from sitegrid import cli
from sitegrid.doctor import Level, folder
from sitegrid.doctor.folder import examine_folder
from sitegrid.setup import files
from sitegrid.setup.files import Folder, models
from sitegrid.setup.hearing import HeardLine
from tests.unit.agents.drivers.frames import TPV, pvt, report, ubx
from tests.unit.agents.drivers.test_can import EEC1, frame
from tests.unit.sitegrid.setup.test_listening import IMU, INDOORS

GNSS = ("fix", "velocity")
MODEL = ("--model", "truck")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A receiver's bytes in a file, in place of its port."""
    path = tmp_path / "drive.ubx"
    path.write_bytes(b"".join(pvt(second=20 + i) + IMU for i in range(4)))
    return path


def init(path: Path, *words: str | Path) -> int:
    return cli.main(["init", str(path / "quarry"), "--seconds", "0.1", *map(str, words)])


@pytest.mark.slow
def test_a_folder_is_made_and_the_doctor_finds_nothing(tmp_path: Path, recording: Path, capsys: Any) -> None:
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    site, machine, config = Folder(tmp_path / "quarry").load()
    assert (site.name, site.origin_lat_deg, machine.name) == ("quarry", 49.010123, "truck-1")
    assert [(d.kind, d.address) for d in config.driver] == [("ubx", str(recording))]
    assert config.driver[0].feeds == {"fix": "gps-1", "velocity": "doppler-1", "imu": "imu-1"}
    capsys.readouterr()
    assert cli.main(["doctor", str(tmp_path / "quarry")]) == 0
    shown = capsys.readouterr().out
    assert not re.findall("^(?:FAIL|WARN)  (?!ports)", shown, re.MULTILINE)
    before = (tmp_path / "quarry" / "agent.toml").read_bytes()
    assert init(tmp_path, "--port", recording, *MODEL) == 1
    assert "agent.toml: is there already, and stays as it is" in capsys.readouterr().err
    assert (tmp_path / "quarry" / "agent.toml").read_bytes() == before


def test_a_second_machine_keeps_the_site_that_is_there(tmp_path: Path, recording: Path) -> None:
    made = tmp_path / "quarry"
    made.mkdir()
    (made / "site.toml").write_text('name = "pit"\norigin_lat_deg = 49.0\norigin_lon_deg = 8.4\n')
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    assert Folder(made).load()[0].name == "pit"


@pytest.mark.parametrize("model", models())
@pytest.mark.parametrize(
    "every",
    [
        [HeardLine("/dev/ttyACM0", "ubx", 115_200, streams=(*GNSS, "heading", "imu", "wheels"))],
        [
            HeardLine("/dev/ttyUSB0", "nmea", 9600, streams=GNSS),
            HeardLine('C:\\"x"', "nmea", streams=(*GNSS, "heading")),
        ],
        [HeardLine("tcp://127.0.0.1:2947", "gpsd", streams=GNSS)],
    ],
    ids=["all streams", "two receivers", "gpsd"],
)
def test_what_is_written_for_any_model_and_receivers_is_read_back(
    tmp_path: Path, model: str, every: list[HeardLine]
) -> None:
    made = Folder(tmp_path / "made")
    files.write(made, files.site_text("pit", (-33.9, 18.4, 0.0)), files.agent_text("m-1", model, every))
    _, machine, config = made.load()
    assert [(d.kind, d.address, tuple(d.feeds)) for d in config.driver] == [
        (h.kind, h.address, h.streams) for h in every
    ]
    assert machine.mass_kg == models()[model]["machine"]["mass_kg"]
    asked = [
        line for line in made.agent_file.read_text("utf-8").splitlines() if re.match("mount|mass|wheel|load", line)
    ]
    assert all("  # " in line for line in asked)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "--model: is missing: kind of machine (loader, truck, excavator, roller, pickup)"),
        (("--model", "tank"), "--model: 'tank' is none of loader, truck"),
        ((*MODEL, "--machine", "Truck 1"), "'Truck 1' is not a name"),
        ((*MODEL, "--origin=91,8.4"), "quarry: site.toml: origin_lat_deg, origin_lon_deg: not a place"),
        ((*MODEL, "--port", "/dev/ttyACM97"), "/dev/ttyACM97: no such port; there "),
        ((*MODEL, "--port", "tcp://a"), "tcp://a: 'tcp://a' is neither tcp://HOST:PORT"),
    ],
)
def test_what_is_wrong_or_missing_is_one_line_where_nobody_is_asked(
    tmp_path: Path, recording: Path, capsys: Any, words: Sequence[str], sentence: str
) -> None:
    assert init(tmp_path, "--port", recording, *words) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("sitegrid: ")
    assert sentence in last
    assert not list((tmp_path / "quarry").glob("*.toml"))


def test_without_a_fix_the_origin_is_asked_for_until_it_is_one(
    tmp_path: Path, recording: Path, capsys: Any, monkeypatch: Any
) -> None:
    recording.write_bytes(INDOORS * 3)
    assert init(tmp_path, "--port", recording, *MODEL) == 1
    assert "--origin: is missing: no receiver has a fix" in capsys.readouterr().err
    answers = iter(("tank", "loader", "", "pit", "north", "-33.9, 18.4"))
    monkeypatch.setattr(sys, "stdin", type("Terminal", (), {"isatty": lambda _: True})())
    monkeypatch.setattr("builtins.input", lambda: next(answers))
    assert init(tmp_path, "--port", recording) == 0
    site, machine, _ = Folder(tmp_path / "quarry").load()
    assert (site.name, site.origin_lat_deg, machine.name) == ("pit", -33.9, "loader-1")
    assert "'north' is not LAT,LON" in capsys.readouterr().err


CHANGES = {
    "lever arm in mm": (
        r"4\.0, 0\.0, 3\.4",
        "4000, 0, 3400",
        Level.FAIL,
        "4000 m is off any machine; if that is mm, write 4",
    ),
    "no lever arm": (r"4\.0, 0\.0, 3\.4", "0.0, 0.0, 0.0", Level.WARN, "gps-1: its mount is 0, 0, 0"),
    "radius in mm": (r"wheel_radius_m = 0\.9", "wheel_radius_m = 900", Level.FAIL, "if that is mm, write 0.9"),
    "mass in tonnes": (r"mass_kg = 22000\.0", "mass_kg = 22", Level.FAIL, "if that is tonnes, write 22000"),
    "a sensor that is not there": ('fix = "gps-1"', 'fix = "gps-2"', Level.FAIL, "no [[sensor]] is named 'gps-2'"),
    "a sensor that is not fed": ('fix = "gps-1", ', "", Level.WARN, "gps-1: nothing feeds it"),
    "a port that is not there": ("drive.ubx", "gone.ubx", Level.FAIL, "gone.ubx: no such port"),
    "another format": (
        'kind = "ubx"',
        'kind = "nmea"',
        Level.FAIL,
        'it sends UBX; say `kind = "ubx"`, or set it to send NMEA',
    ),
    "a stream that does not come": ('kind = "imu"', 'kind = "encoder"', Level.FAIL, "imu feeds one of kind imu"),
    "no file": (".+", "", Level.FAIL, "no [machine] is described"),
    "no TOML": ("name = ", "name ", Level.FAIL, "not valid TOML"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_the_doctor_says_of_a_folder_what_is_wrong(tmp_path: Path, recording: Path, case: str) -> None:
    old, new, level, sentence = CHANGES[case]
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    agent = tmp_path / "quarry" / "agent.toml"
    text = agent.read_text("utf-8")
    changed = re.sub(old, new, text)
    assert changed != text
    agent.write_text(changed, encoding="utf-8")
    findings = [finding for finding in examine_folder(tmp_path / "quarry") if sentence in str(finding)]
    assert [finding.level for finding in findings] == [level], sentence


@pytest.mark.parametrize(
    ("sent", "level", "sentence"),
    [
        ((INDOORS + IMU) * 3, Level.WARN, "no fix, 3 satellites"),
        (b"", Level.FAIL, "nothing comes"),
        (pvt(), Level.WARN, "nothing comes for imu; switch its messages on"),
        (pvt(lat_1e7=491_000_000) + IMU, Level.WARN, "10 km from here"),
        (pvt(lat_1e7=590_000_000) + IMU, Level.FAIL, "so all fixes are refused (extent_m); a site of this place"),
        (ubx("NAV-DOP") * 3, Level.FAIL, "it sends no positions"),
        (report(TPV), Level.FAIL, 'it sends GPSD; say `kind = "gpsd"`'),
        (nmea("GNGLL,4900.6,N,00824.0,E,101527.2,A,R"), Level.FAIL, "switch on GGA and RMC"),
    ],
)
def test_the_doctor_says_what_a_receiver_does_that_worked_before(
    tmp_path: Path, recording: Path, sent: bytes, level: Level, sentence: str
) -> None:
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    recording.write_bytes(sent)
    findings = [finding for finding in examine_folder(tmp_path / "quarry") if sentence in str(finding)]
    assert [finding.level for finding in findings] == [level]


ON_BUS = """
[machine.powertrain]
reference_torque_nm = 2300.0
[[sensor]]
name = "engine"
kind = "engine"
[[sensor]]
name = "load"
kind = "payload"
[[driver]]
kind = "can"
address = {address}
feeds = {{ engine = "engine", load = "load" }}
[driver.signals.load]
pgn = 65300
start = 0
bits = 8
"""
LOAD = (3 << 26 | 65300 << 8, b"\x20")


@pytest.mark.parametrize(
    ("sent", "level", "sentence"),
    [
        ((EEC1, LOAD), Level.PASS, "can feeds engine, load"),
        ((frame(61444), LOAD), Level.WARN, "nothing comes for engine; switch its messages on"),
        ((frame(64000),), Level.FAIL, "1 frames, and none that the built-in table knows"),
        ((), Level.FAIL, "the bus is silent: is the ignition on"),
    ],
)
def test_the_doctor_listens_to_a_bus_with_the_signals_of_its_driver(
    tmp_path: Path, recording: Path, sent: Sequence[tuple[int, bytes]], level: Level, sentence: str
) -> None:
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    bus = tmp_path / "bus.log"
    bus.write_text("".join(f"(1795688127.0) can0 {identifier:08X}#{data.hex()}\n" for identifier, data in sent))
    with (tmp_path / "quarry" / "agent.toml").open("a", encoding="utf-8") as agent:
        agent.write(ON_BUS.format(address=json.dumps(str(bus))))
    findings = [finding for finding in examine_folder(tmp_path / "quarry") if str(bus) in str(finding)]
    assert [finding.level for finding in findings] == [level]
    assert sentence in str(findings[0])


def test_the_doctor_looks_at_data_and_ports_and_leaves_a_running_agent_its_receivers(
    tmp_path: Path, recording: Path, monkeypatch: Any
) -> None:
    assert init(tmp_path, "--port", recording, *MODEL) == 0
    made = Folder(tmp_path / "quarry")
    made.store.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(folder, "PORTS", (server.getsockname()[1],))
        shown = "\n".join(map(str, examine_folder(made.path)))
    assert re.search("FAIL  store .*holds no journal", shown)
    assert re.search(r"WARN  ports .*taken: \d+; `sitegrid up` takes others", shown)
    with closing(Spool(made.spool, SpoolConfig())):
        shown = "\n".join(map(str, examine_folder(made.path)))
    assert re.search("-     receiver .*an agent runs in this folder", shown)
