"""Foreign recordings become complete log folders, or none; ambiguities are asked."""

from __future__ import annotations

import errno
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.drivers.can.pgns import SIGNALS
from agents.drivers.can.signals import EXTENDED, frame_of
from protocol.errors import ConfigError, LogFolderError, SitegridError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.readings import columns
from sitegrid.cli import main
from sitegrid.command_line import build_parser
from sitegrid.convert import command
from sitegrid.convert.command import convert
from tests.paths import ROOT
from tests.unit.agents.drivers.frames import recording
from tests.unit.sitegrid.convert.bags import FORMS, LATE_NS, STEP_NS, T0, header, write_bag

N = 20
IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
ODOMETRY, TWIST, JOINTS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped", "sensor_msgs/msg/JointState"
STAMPS = [T0 + i * STEP_NS for i in range(N)]


def said(fields: Any, stamps: list[int] = STAMPS, frame: str = "base_link") -> list[tuple[int, dict[str, Any]]]:
    """Messages from `fields` of their number."""
    return [(T0 + i * STEP_NS + LATE_NS, {"header": header(ns, frame), **fields(i)}) for i, ns in enumerate(stamps)]


def fix(i: int, **others: Any) -> dict[str, Any]:
    diagonal = np.diag([0.5, 0.25, 4.0]).ravel()
    place = {"latitude": 49.0 + i / 7e5, "longitude": 8.4 - i / 3e5, "altitude": 110.1 + i / 3}
    return {**place, "position_covariance": diagonal, "position_covariance_type": 2, **others}


def imu(i: int, **others: Any) -> dict[str, Any]:
    rates, forces = {"x": i / 7, "y": -i / 11, "z": 0.1}, {"x": 0.3, "y": i / 13, "z": 9.81}
    return {"angular_velocity": rates, "linear_acceleration": forces, "orientation": {"w": 1.0}, **others}


def odometry(i: int) -> dict[str, Any]:
    twist = {"linear": {"x": i / 3, "y": 0.01}, "angular": {"z": -i / 9}}
    return {"child_frame_id": "base_link", "twist": {"twist": twist}}


def twist(i: int) -> dict[str, Any]:
    return {"twist": {"linear": {"x": i / 3, "y": i / 7}, "angular": {"z": 0.1}}}


DRIVE = {"/fix": (FIX, said(fix)), "/imu": (IMU, said(imu)), "/odom": (ODOMETRY, said(odometry))}
ODOM = ("/odom", ("odometry",))


def rows(log: LogFolder, kind: str) -> list[tuple[float, ...]]:
    """Stamps and values of a kind, read through the log."""
    return [(r.stamp_ns, *(getattr(r, name) for name in columns(kind))) for r in log.readings() if r.kind == kind]


def bag(tmp_path: Path, form: str = "mcap", **topics: Any) -> Path:
    return write_bag(tmp_path, form, {f"/{name}": topic for name, topic in topics.items()})


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_a_bag_comes_out_of_the_log_door_bit_for_bit(tmp_path: Path, form: str) -> None:
    report = convert(write_bag(tmp_path, form, DRIVE), tmp_path / "log", [ODOM])
    log = open_log(tmp_path / "log")
    assert len(list(log.readings())) == 3 * N
    assert not log.refused
    assert rows(log, "gps") == [
        (ns, 49.0 + i / 7e5, 8.4 - i / 3e5, 110.1 + i / 3, 0.5, 0.25, 4.0) for i, ns in enumerate(STAMPS)
    ]
    assert rows(log, "imu") == [(ns, i / 7, -i / 11, 0.1, 0.3, i / 13, 9.81) for i, ns in enumerate(STAMPS)]
    assert rows(log, "odometry") == [(ns, i / 3, 0.01, -i / 9) for i, ns in enumerate(STAMPS)]
    assert {(row["topic"], row["sensor"], row["rows"], row["rate_hz"]) for row in report["took"]} == {
        ("/fix", "gps", N, 10.0),
        ("/imu", "imu", N, 10.0),
        ("/odom", "odometry", N, 10.0),
    }
    assert report["left_out"] == [
        "/imu as attitude (orientation, orientation_covariance [rad2]): --take '/imu=attitude' takes it"
    ]
    assert [line.partition(":")[0] for line in report["to_do"]] == ["[site]", "[machine]"]
    assert (log.site.origin_lat_deg, log.site.origin_lon_deg) == (49.0, 8.4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topics", "takes", "question"),
    [
        ({"odom": (ODOMETRY, said(odometry))}, [], r"/odom .*: --take /odom=odometry\|none"),
        ({"v": (TWIST, said(twist))}, [], r"/v .*: --take /v=odometry\|gps_velocity\|none"),
        ({"raw": (IMU, said(imu))}, [], r"/imu \(2 of .*\): --take /imu=.*/raw \(2 of"),
        ({"filtered": (FIX, said(fix))}, [], r"/fix \(2 of .*/filtered \(2 of"),
        ({}, ["/imo=imu"], "no topic /imo can be taken; there are /fix, /imu"),
        ({}, ["/imu=gps"], "/imu is no gps; it can be imu, attitude, none"),
        ({"j": (JOINTS, said(lambda _: {"name": ["a", "b"]}))}, ["/j=encoder"], r"as '/j\[a,b\]=encoder'"),
        (
            {"j": (JOINTS, said(lambda _: {"name": ["a", "b"]}))},
            ["/j[a,c]=encoder"],
            r"at most 2 of its joints, as '/j\[a,b\]=encoder' \(a, b\)",
        ),
        (
            {"j": (JOINTS, said(lambda _: {"name": ["a", "b"]}))},
            ["/j[a,b]=steering"],
            r"at most 1 of its joints, as '/j\[a\]=steering'",
        ),
    ],
)
def test_what_may_be_several_things_is_asked_and_nothing_is_written(
    tmp_path: Path, topics: dict[str, Any], takes: list[str], question: str
) -> None:
    path = bag(tmp_path, fix=DRIVE["/fix"], imu=DRIVE["/imu"], **topics)
    options = build_parser().parse_args(["log", "convert", "x", *(w for take in takes for w in ("--take", take))])
    with pytest.raises(ConfigError, match=question):
        convert(path, tmp_path / "log", options.take)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@pytest.mark.slow
def test_an_answer_decides_and_what_it_leaves_out_is_said(tmp_path: Path) -> None:
    joints = said(lambda i: {"name": ["left", "right", "hitch"], "position": np.array([i, -i, i / 50.0])})
    path = bag(
        tmp_path,
        fix=DRIVE["/fix"],
        imu=DRIVE["/imu"],
        raw=(IMU, said(imu)),
        odom=DRIVE["/odom"],
        v=(TWIST, said(twist)),
        j=(JOINTS, joints),
        words=("std_msgs/msg/String", [(T0, {"data": "go"})]),
    )
    takes = [("/imu", ("imu", "attitude")), ("/odom", ("none",)), ("/v", ("gps_velocity",))]
    takes += [("/j[left,right]", ("encoder",)), ("/j[hitch]", ("articulation",))]
    report = convert(path, tmp_path / "log", takes)
    assert {row["sensor"] for row in report["took"]} == {
        *("gps", "imu", "attitude", "gps-velocity", "encoder", "articulation"),
    }
    assert "/raw: another sensor_msgs/msg/Imu is taken" in report["left_out"]
    assert "/words: std_msgs/msg/String is not read" in report["left_out"]
    assert any(line.startswith("/v as odometry (twist") for line in report["left_out"])
    log = open_log(tmp_path / "log")
    per_rad = 100 / math.tau
    assert rows(log, "encoder") == [(ns, i * per_rad, -i * per_rad) for i, ns in enumerate(STAMPS)]
    assert rows(log, "articulation") == [(ns, i / 50.0) for i, ns in enumerate(STAMPS)]
    unstated = [sensor.name for sensor in log.machine.sensors if not sensor.use]
    assert unstated == ["attitude", "gps-velocity"], "neither states an error"
    assert any(line.startswith("gps-velocity: 20 of 20 rows state no error: write `std") for line in report["to_do"])


@pytest.mark.slow
def test_what_a_message_does_not_state_is_neither_made_up_nor_dropped_in_silence(tmp_path: Path) -> None:
    no_rate = {"angular_velocity_covariance": np.array([-1.0, *[0.0] * 8])}
    fixes = said(lambda i: fix(i, status={"status": -1 if i == 3 else 0}, position_covariance_type=0 if i == 5 else 2))
    fixes[7][1]["latitude"] = math.nan
    fixes[9][1]["header"] = header(0)
    unstamped = [(ns, {"twist": odometry(i)["twist"]["twist"]}) for i, ns in enumerate(STAMPS)]
    path = bag(
        tmp_path,
        fix=(FIX, fixes),
        imu=(IMU, said(lambda i: imu(i, **no_rate), frame="imu_link")),
        odom=("geometry_msgs/msg/TwistWithCovariance", unstamped),
    )
    report = convert(path, tmp_path / "log", [ODOM])
    log = open_log(tmp_path / "log")
    assert [s.measures for s in log.machine.sensors if s.kind == "imu"] == [("force",)]
    assert rows(log, "odometry")[4] == (STAMPS[4], 4 / 3, 0.01, -4 / 9)
    left = [line for line in report["left_out"] if line.startswith("/fix as gps: 1 of 20 (")]
    assert {line.partition("(")[2].partition(")")[0] for line in left} == {"no fix", "not_finite", "no stamp"}
    to_do = "\n".join(report["to_do"])
    assert "gps: 1 of 17 rows state no error" in to_do
    assert "imu: where frame imu_link is on the machine is not known: measure `mount`" in to_do
    assert "odometry: its messages have no stamps: the recorder's clock is taken" in to_do


@pytest.mark.slow
def test_names_from_a_stranger_stay_comments(tmp_path: Path) -> None:
    frame = 'x"\n[[sensor]]\nname = "evil"'
    path = bag(tmp_path, fix=(FIX, said(fix, frame=frame)), **{"a\nb": ("std_msgs/msg/String", [(T0, {"data": ""})])})
    report = convert(path, tmp_path / "log")
    assert [sensor.name for sensor in open_log(tmp_path / "log").machine.sensors] == ["gps"]
    assert all(line.isprintable() for line in (*report["left_out"], *report["to_do"]))


@pytest.mark.slow
def test_stamps_that_go_back_are_kept_and_said(tmp_path: Path) -> None:
    stamps = [*STAMPS[:5], STAMPS[2] + 1, *STAMPS[5:]]
    report = convert(bag(tmp_path, fix=(FIX, said(fix, stamps))), tmp_path / "log")
    assert "gps: 1 of 21 stamps go back: see `sitegrid log check`" in report["to_do"]
    log = open_log(tmp_path / "log")
    assert len(list(log.readings())) == N
    assert log.refused == {"stamp_goes_back": 1}


@pytest.mark.slow
def test_a_manifest_once_completed_is_that_of_the_next_drive(tmp_path: Path) -> None:
    path = bag(tmp_path, fix=(FIX, said(lambda i: fix(i, position_covariance_type=0))), imu=DRIVE["/imu"])
    convert(path, tmp_path / "first")
    convert(path, tmp_path / "second")
    manifest = tmp_path / "first" / "log.toml"
    text = manifest.read_text().replace("std = {}", "std = { position = 2.5 }", 1).replace("use = false", "use = true")
    manifest.write_text(text)
    fixes = [r for r in open_log(manifest, tmp_path / "second").readings() if r.kind == "gps"]
    assert [fix.var_e_m2 for fix in fixes] == [6.25] * N


GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">
<wpt lat="1" lon="2"/>
<trk><trkseg>
<trkpt lat="49.0" lon="8.4"><ele>110.5</ele><time>2025-06-15T15:06:40Z</time></trkpt>
<trkpt lat="49.00001" lon="8.4"><time>2025-06-15T17:06:41.25+02:00</time></trkpt>
<trkpt lat="49.00002" lon="8.4"/><trkpt lat="49.00003" lon="8.4"><time>2025-06-15T15:06:43</time></trkpt>
</trkseg></trk></gpx>
"""


def test_a_track_has_its_points_with_time_and_waits_for_its_error(tmp_path: Path) -> None:
    (tmp_path / "walk.gpx").write_text(GPX)
    report = convert(tmp_path / "walk.gpx", tmp_path / "walk")
    assert [line.partition(", the first")[0] for line in report["left_out"]] == [
        "trkpt as gps: 1 of 4 (no time)",
        "trkpt as gps: 1 of 4 (its time names no zone, as Z or +02:00)",
    ]
    manifest = tmp_path / "walk" / "log.toml"
    assert not open_log(manifest).machine.sensors[0].use
    manifest.write_text(manifest.read_text().replace("use = false", "use = true").replace("{}", "{ position = 4.0 }"))
    assert rows(open_log(manifest), "gps") == [
        (T0, 49.0, 8.4, 110.5, 16.0, 16.0, 100.0),
        (T0 + 1_250_000_000, 49.00001, 8.4, 0.0, 16.0, 16.0, 100.0),
    ]


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.bag", b"#ROSBAG V2.0\nnothing", "cannot be read"),
        ("a.bag", b"PK\x03\x04 no bag", "is no bag of ROS, no MCAP, no GPX, and no receiver's positions are in it"),
        ("a.mcap", b"\x89MCAP0\r\n" + bytes(100), "is an MCAP file, but not of ROS 2"),
        ("a.db3", b"SQLite format 3\0" + bytes(100), "cannot be read"),
        ("a.nmea", b"$GPGGA,cut", "no receiver's positions are in it"),
        ("a.gpx", GPX.encode()[:400], "no whole GPX"),
        ("a.gpx", b"<gpx></gpx>", "nothing in it can be used"),
        ("a.ubx", b"", "is empty"),
        ("missing", None, "is neither a file nor the folder of a bag"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line_and_leaves_nothing(
    tmp_path: Path, name: str, content: bytes | None, problem: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(LogFolderError, match=problem) as caught:
        convert(tmp_path / name, tmp_path / "log")
    assert str(tmp_path / name) in str(caught.value)
    assert {one.name for one in tmp_path.iterdir()} <= {name}


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_a_bag_that_was_cut_or_damaged_is_refused_or_read_and_never_half_written(tmp_path: Path, form: str) -> None:
    path = write_bag(tmp_path, form, DRIVE)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    whole, seed = file.read_bytes(), 20261127
    draw = np.random.default_rng(seed)
    for case in range(12):
        data = bytearray(whole[: draw.integers(20, len(whole))] if case % 2 else whole)
        data[draw.integers(16, len(data))] ^= 0xFF
        file.write_bytes(data)
        try:
            convert(path, tmp_path / f"log{case}", [ODOM])
        except SitegridError:
            assert not (tmp_path / f"log{case}").exists(), f"seed {seed}"
        else:
            open_log(tmp_path / f"log{case}")
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_without_a_position_there_is_no_site(tmp_path: Path) -> None:
    with pytest.raises(LogFolderError, match=r"has no position, so no place for its site"):
        convert(bag(tmp_path, imu=DRIVE["/imu"]), tmp_path / "log")


def test_a_folder_that_exists_stays_and_a_full_disk_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "walk.gpx").write_text(GPX)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    assert main(["log", "convert", "walk.gpx", "there"]) == 1
    assert "there: exists, and stays as it is" in capsys.readouterr().err

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(command, "manifest_toml", full)
        assert main(["log", "convert", "walk.gpx"]) == 1
    assert "make room" in capsys.readouterr().err
    assert {one.name for one in tmp_path.iterdir()} == {"walk.gpx", "there"}
    assert main(["log", "convert", "walk.gpx"]) == 0
    assert "written: walk/log.toml. Then: sitegrid log check walk" in capsys.readouterr().out


def test_a_bag_without_rosbags_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
    assert main(["log", "convert", str(tmp_path / "a.bag"), str(tmp_path / "log")]) == 1
    assert "rosbags is not installed: pip install '.[agent,recordings]'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "takes", "counts"),
    [
        ("nmea_drive_f9k.nmea", [], {"gps": 1653, "gps-velocity": 1653}),
        ("ubx_m8l_esf_hnr.log", [], {"gps": 19, "gps-velocity": 19, "imu": 205, "encoder": 185}),
        ("nmea_rtk_short.log", [("fix", ("gps",))], {"gps": 121}),
        ("ros1_husky.bag", [("/husky_velocity_controller/odom", ("odometry",))], {"gps": 989, "imu": 11865}),
    ],
)
def test_real_recordings_are_read_whole(tmp_path: Path, name: str, takes: Any, counts: dict[str, int]) -> None:
    report = convert(recording(name), tmp_path / "log", takes)
    n_rows = {row["sensor"]: row["rows"] for row in report["took"]}
    assert counts.items() <= n_rows.items()
    log = open_log(tmp_path / "log")
    assert sum(1 for _ in log.readings()) == sum(n_rows.values())
    assert not log.refused


@pytest.mark.nightly
@pytest.mark.slow
def test_a_raw_bag_is_the_held_log_of_its_drive_but_for_the_digits_that_the_log_was_cut_to(tmp_path: Path) -> None:
    """The reference log has 0.1 ms, nine decimals of degrees, six digits elsewhere."""
    data = recording("ros1_husky.bag").parents[1] / "rl_test1_husky"
    convert(recording("ros1_husky.bag"), tmp_path / "log", [("/husky_velocity_controller/odom", ("odometry",))])
    raw, held = open_log(tmp_path / "log"), open_log(ROOT / "lab/logs/rl_test1_husky", data)
    for kind, digits in (("gps", "{:.9f}"), ("imu", "{:.6g}"), ("odometry", "{:.6g}")):
        n_values = 2 if kind == "odometry" else None  # the reference log lacks turn rates
        pairs = list(zip(rows(raw, kind), rows(held, kind), strict=True))
        assert max(abs(mine[0] - theirs[0]) for mine, theirs in pairs) < 51_000, kind
        for mine, theirs in pairs:
            assert [digits.format(v) for v in mine[1:][:n_values]] == [digits.format(v) for v in theirs[1:][:n_values]]


def test_two_talkers_are_one_receiver_or_two_and_somebody_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="gn, gp send positions; of several receivers say --take gn:fix=gps"):
        convert(recording("nmea_rtk_short.log"), tmp_path / "log")


def test_a_recording_of_a_bus_becomes_a_log_folder_and_an_engine_waits_for_its_powertrain(tmp_path: Path) -> None:
    """The agent's values; of two speeds one is taken, one offered."""
    values = {"engine_torque": 0.4, "engine_speed": 150.0, "rear_left_speed": 2.0, "rear_right_speed": 2.0}
    values |= {"vehicle_speed": 2.0, "latitude": 49.01, "longitude": 8.4, "fuel_rate": 20.0}
    groups = {SIGNALS[name].group for name in values}
    lines = []
    for i in range(20):
        for group in groups:
            own = [(SIGNALS[name], value) for name, value in values.items() if SIGNALS[name].group == group]
            pgn = group - EXTENDED
            lines.append(f"({1.75e9 + i / 10:.6f}) can0 {3 << 26 | pgn << 8:08X}#{frame_of(own).hex()}")
    file = tmp_path / "drive.candump"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    report = convert(file, tmp_path / "log")
    assert {row["kind"]: row["rows"] for row in report["took"]} == dict.fromkeys(
        ("engine", "odometry", "gps", "fuel_rate"), 20
    )
    assert any("speed of CCVS1" in line and "--take" in line for line in report["left_out"])
    assert any("`powertrain` of [machine]" in line for line in report["to_do"])
    log = open_log(tmp_path / "log")
    (engine,) = (sensor for sensor in log.machine.sensors if sensor.kind == "engine")
    assert not engine.use
    assert next(one for one in log.machine.sensors if one.kind == "odometry").measures == ("speed",)
    assert {values[0] for _, *values in rows(log, "fuel_rate")} == {20.0}


def test_a_bus_without_a_value_that_is_known_is_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "drive.log"
    file.write_text("(1750000000.000000) can0 18FF0000#0000000000000000\n", encoding="utf-8")
    with pytest.raises(LogFolderError, match="1 frames, and none that the built-in table knows"):
        convert(file, tmp_path / "log")
