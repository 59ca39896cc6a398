import gzip
import math
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import open_log, write_log
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import KINDS, Articulation
from protocol.site.site_config import SiteConfig

T0 = 1_750_000_000_000_000_000
MANIFEST = f"""
[log]
name = "test"
start_ns = {T0}
[site]
name = "paper"
origin_lat_deg = 49.0
origin_lon_deg = 8.4
[machine]
name = "loader-1"
[[sensor]]
name = "joint"
kind = "articulation"
file = "joint.csv"
[sensor.columns]
stamp = {{ column = "t", unit = "ms" }}
angle_rad = {{ column = "angle", unit = "deg" }}
"""


def folder(tmp_path, manifest=MANIFEST, **files):
    (tmp_path / "log.toml").write_text(manifest)
    for name, text in {"joint": "t,angle\n0,0\n1000,90\n", **files}.items():
        if text is not None:
            (tmp_path / f"{name}.csv").write_text(text)
    return tmp_path


def test_units_are_converted_and_stamps_count_from_the_start(tmp_path):
    log = open_log(folder(tmp_path))
    assert list(log.readings()) == [
        Articulation("joint", T0, 0.0),
        Articulation("joint", T0 + 10**9, pytest.approx(math.pi / 2)),
    ]
    assert not log.refused


def test_bad_rows_are_left_out_and_counted_by_reason(tmp_path):
    text = "t,angle\n0,1\n1,x\n2\n,3\n3,nan\n4,inf\n5,400\n6,2\n5,2\ninf,1\n7,2\n7,3\n"
    log = open_log(folder(tmp_path, joint=text))
    expected = {"wrong_type": 4, "not_finite": 2, "out_of_range": 1, "stamp_goes_back": 1}
    for _ in range(2):  # counted anew each time
        assert [r.stamp_ns - T0 for r in log.readings()] == [0, 6_000_000, 7_000_000, 7_000_000]
        assert log.refused == expected


def test_gzip_and_the_mark_of_spreadsheets(tmp_path):
    manifest = MANIFEST.replace("joint.csv", "joint.csv.gz")
    folder(tmp_path, manifest, joint=None)
    (tmp_path / "joint.csv.gz").write_bytes(gzip.compress("\ufefft,angle\r\n0,1\r\n".encode()))
    assert len(list(open_log(tmp_path).readings())) == 1


@pytest.mark.parametrize("damage", ["cut", "flip", "plain"])
def test_damaged_gzip_is_named(tmp_path, damage):
    manifest = MANIFEST.replace("joint.csv", "joint.csv.gz")
    folder(tmp_path, manifest, joint=None)
    data = bytearray(gzip.compress(("t,angle\n" + "".join(f"{i},{i % 3}\n" for i in range(5000))).encode()))
    if damage == "flip":
        data[40:60] = bytes(20)
    (tmp_path / "joint.csv.gz").write_bytes({"cut": data[:-20], "flip": data, "plain": b"t,angle\n"}[damage])
    with pytest.raises(LogFolderError, match=r"joint\.csv\.gz"):
        list(open_log(tmp_path).readings())


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "test"', "", "`name` is missing"),
        ("[log]", "[extra]\n[log]", "unknown key `extra`"),
        ('kind = "articulation"', 'kind = "sonar"', "'sonar' is none of"),
        ('angle_rad = { column = "angle", unit = "deg" }', "", "`angle_rad` is not described"),
        ('unit = "deg"', 'unit = "furlong"', "unit `furlong` is not known"),
        ('{ column = "angle", unit = "deg" }', "{ value = nan }", "finite"),
        ("[[sensor]]", "[sensor]", "no .*sensor.* is described"),
        ("[[sensor]]", MANIFEST[MANIFEST.index("[[sensor]]") :] + "[[sensor]]", "two are named 'joint'"),
    ],
)
def test_wrong_manifest_is_refused_by_name(tmp_path, old, new, words):
    assert old in MANIFEST
    with pytest.raises(ConfigError, match=words) as caught:
        open_log(folder(tmp_path, MANIFEST.replace(old, new, 1)))
    assert "log.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("file", "problem"),
    [
        ("../outside.csv", "lies outside of the data folder"),
        ("/etc/hostname", "lies outside of the data folder"),
        ("sub/../../outside.csv", "lies outside of the data folder"),
        ("link.csv", "lies outside of the data folder"),
        ("there/outside.csv", "lies outside of the data folder"),
        ("loop.csv", "cannot be read"),
        ("fifo.csv", "is no regular file"),
        ("sub", "is no regular file"),
        ("a\\u0000b", "is no name of a file"),
        ("wide.csv", "has 1001 columns, over 1000"),
    ],
)
def test_a_manifest_of_a_stranger_stays_in_its_folder_and_reads_files(tmp_path, file, problem):
    data = folder(tmp_path, MANIFEST.replace("joint.csv", file), joint=None)
    elsewhere = tmp_path.parent / f"{tmp_path.name}-elsewhere"
    for place in (data / "sub", elsewhere):
        place.mkdir()
    (data / "wide.csv").write_text(",".join(["t", "angle", *map(str, range(999))]))
    for name, target in {
        "link.csv": elsewhere / "outside.csv",
        "there": elsewhere,
        "loop.csv": data / "loop.csv",
    }.items():
        (data / name).symlink_to(target)
    for outside in (elsewhere / "outside.csv", tmp_path.parent / "outside.csv"):
        outside.write_text("t,angle\n0,0\n")
    os.mkfifo(data / "fifo.csv")
    with pytest.raises(LogFolderError) as caught:
        list(open_log(data).readings())
    assert problem in str(caught.value)


def test_files_below_the_data_folder_are_read_also_through_links(tmp_path):
    data = folder(tmp_path, MANIFEST.replace("joint.csv", "day/one.csv"), joint=None)
    (data / "day").mkdir()
    (data / "two.csv").write_text("t,angle\n0,0\n")
    (data / "day" / "one.csv").symlink_to(data / "two.csv")
    (tmp_path.parent / f"{tmp_path.name}-link").symlink_to(data)
    assert len(list(open_log(tmp_path.parent / f"{tmp_path.name}-link").readings())) == 1


# --- round trips -----------------------------------------------------------------------------------------------------

SITE = SiteConfig("paper", 49.1, 8.4, 110.5)
MOUNT = Mount((0.1, -0.2, 3.0), (0.0, 90.0, -90.0))
SENSORS = tuple(SensorConfig(f"{kind}-1", kind, MOUNT, drift_time_s=60.0) for kind in KINDS)
TRAIN = PowertrainConfig(reference_torque_nm=1900.0, reverse_gears=(13.0, 11.0), final_drive=5.1)
MACHINE = MachineConfig("loader-1", mass_kg=17_000.5, wheelbase_m=2.5, powertrain=TRAIN, sensors=SENSORS)


@st.composite
def recordings(draw):
    readings = []
    for kind, cls in KINDS.items():
        limits = [st.floats(low, high) for low, high in cls.limits.values()]
        stamps = st.integers(T0, T0 + 11 * 3600 * 10**9)  # recordings end within half a day
        readings += draw(st.lists(st.builds(cls, st.just(f"{kind}-1"), stamps, *limits), max_size=3))
    return sorted(readings, key=lambda r: r.stamp_ns)


@settings(max_examples=30)
@given(recordings())
def test_written_log_reads_back_exactly(tmp_path_factory, readings):
    where = tmp_path_factory.mktemp("log")
    write_log(where, 'a "quoted" \\ näme', SITE, MACHINE, readings)
    log = open_log(where)
    assert (log.name, log.site, log.machine, log.start_ns) == ('a "quoted" \\ näme', SITE, MACHINE, 0)
    got = list(log.readings())
    assert [r.stamp_ns for r in got] == [r.stamp_ns for r in readings]
    assert sorted(map(repr, got)) == sorted(map(repr, readings))
    assert not log.refused
