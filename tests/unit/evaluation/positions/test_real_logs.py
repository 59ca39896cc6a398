"""Real logs: withheld fixes, truth, planar fixes; on made-up logs, and on real ones where they are at hand."""

import math
from pathlib import Path

import numpy as np
import pytest

from evaluation.campaign.figures import Report
from evaluation.positions import real_logs
from evaluation.positions.configurations import Configuration, select
from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import open_log
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection
from tests.paths import ROOT
from tests.paths import SHARED_DATA as DATA

LOGS = ROOT / "evaluation" / "logs"
ROW = Configuration("ukf", 1, 1, "default")
MANIFEST = """
log = { name = "circle", start_ns = 1700000000000000000 }
site = { name = "yard", origin_lat_deg = 50.0, origin_lon_deg = 8.0 }
machine = { name = "mower" }
[[sensor]]
name = "wheels"
kind = "odometry"
file = "odom.csv"
columns = { stamp = "t", speed_x_mps = "v", speed_y_mps = { value = 0.0 }, rate_z_radps = "w" }
[[sensor]]
name = "gyro"
kind = "imu"
file = "odom.csv"
[sensor.columns]
stamp = "t"
gyro_x_radps = { value = 0.0 }
gyro_y_radps = { value = 0.0 }
gyro_z_radps = "w"
force_x_mps2 = { value = 0.0 }
force_y_mps2 = { value = 0.0 }
force_z_mps2 = { value = 9.81 }
"""
GPS = """
[[sensor]]
name = "gps-{i}"
kind = "gps"
file = "gps{i}.csv"
use = {use}
[sensor.columns]
stamp = "t"
lat_deg = "lat_deg"
lon_deg = "lon_deg"
height_m = {{ value = 0.0 }}
var_e_m2 = {{ value = 1.0 }}
var_n_m2 = {{ value = 1.0 }}
var_u_m2 = {{ value = 1.0 }}
"""
SIDE = """
truth = { file = "truth.csv", stamp = "t", x_m = "east", y_m = "north" }
[[planar]]
file = "gps1.csv"
x_m = "x"
y_m = "y"
"""
RADIUS_M, RATE_RADPS = 20.0, 0.1


def at(t: float, off_m: float = 0.0) -> tuple[float, float]:
    """On a circle about (100, 50), and off_m to the east of it."""
    return 100 + RADIUS_M * math.cos(RATE_RADPS * t) + off_m, 50 + RADIUS_M * math.sin(RATE_RADPS * t)


def write(path: Path, names: str, rows: list[tuple[float, ...]]) -> None:
    path.write_text("\n".join([names, *(",".join(f"{v:.6f}" for v in row) for row in rows)]) + "\n")


@pytest.fixture
def circle(tmp_path: Path) -> Path:
    """A log of 100 s whose GPS is 2 m too far to the east: truth and fixes disagree by that."""
    times = np.arange(0, 100, 0.1)
    write(tmp_path / "odom.csv", "t,v,w", [(t, RADIUS_M * RATE_RADPS, RATE_RADPS) for t in times])
    write(tmp_path / "truth.csv", "t,east,north", [(t, *at(t)) for t in times])
    write(tmp_path / "gps1.csv", "t,x,y", [(t, *at(t, 2.0)) for t in times[::2]])
    write(tmp_path / "gps2.csv", "t,lat_deg,lon_deg", [])
    gps = [GPS.format(i=i, use=use) for i, use in ((1, "true"), (2, "false"))]
    (tmp_path / "log.toml").write_text("".join([MANIFEST, *gps]))
    (tmp_path / "evaluation.toml").write_text(SIDE)
    return tmp_path


def run(folder: Path, *patterns: tuple[float, float], data: Path | None = None) -> Report:
    with real_logs.opened(folder, data) as (log, truth):
        return real_logs.run(log, truth, ROW, patterns or real_logs.WITHHOLD)


@pytest.mark.slow
def test_errors_against_fixes_and_against_truth_stand_apart(circle: Path):
    none, often = run(circle, (0.0, 1.0), (10.0, 30.0))["rows"]
    assert (none["withhold"], none["fixes"], none["rms_m"]) == ("none", 0, None)
    assert (often["withhold"], often["fixes"]) == ("10/30", 100)  # 5 Hz for 10 s in 30, from 40 s on
    assert often["rms_m"] < 0.8
    for row in (none, often):
        assert row["truth_net_m"] == pytest.approx(2.0, abs=0.6)
        assert row["truth_rmse_x_m"] == pytest.approx(2.0, abs=0.6)
        assert row["truth_rmse_y_m"] < 0.8
    assert often["truth_withheld_m"] == pytest.approx(2.0, abs=0.6)
    assert math.isnan(none["truth_withheld_m"])
    assert none["truth_covered"] > often["truth_covered"] > 0.7


def test_without_a_side_file_there_is_no_truth(circle: Path):
    (circle / "evaluation.toml").unlink()
    write(circle / "gps1.csv", "t,lat_deg,lon_deg", [(0.2 * i, 50.0, 8.0) for i in range(9)])
    row = run(circle, (1.0, 10.0))["rows"][0]
    assert not any(name.startswith("truth") for name in row)


def test_planar_fixes_come_back_as_the_metres_that_they_were(circle: Path):
    with real_logs.opened(circle / "log.toml") as (log, _):
        to_map = Projection(log.site).to_map
        fixes = [r for r in log.readings() if isinstance(r, Gps)]
        places = np.array([to_map(f.lat_deg, f.lon_deg, 0.0)[:2] for f in fixes])
    expected = np.array([at((f.stamp_ns - log.start_ns) * 1e-9, 2.0) for f in fixes])
    assert places == pytest.approx(expected, abs=1e-5)
    names = "evaluation.toml gps1.csv gps2.csv log.toml odom.csv truth.csv"
    assert sorted(p.name for p in circle.iterdir()) == names.split()


def test_receivers_in_use_are_counted_and_chosen(circle: Path):
    with real_logs.opened(circle) as (log, _):
        assert real_logs.receivers(log.machine) == 1
        assert real_logs.receivers(select(log.machine, gps=2)) == 2


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('file = "gps1.csv"', 'file = "gps9.csv"', "no sensor with the file 'gps9.csv'"),
        ('x_m = "east"', 'x_m = "west"', "no truth as described: 'west'"),
        ('x_m = "x"', 'x_m = "z"', "no planar fixes as described: 'z'"),
        ('file = "truth.csv"', 'file = "lost.csv"', "cannot be read"),
        ("truth =", "truht =", "unknown key `truht`"),
    ],
)
def test_a_wrong_side_file_is_refused_in_one_line(circle: Path, old: str, new: str, problem: str):
    (circle / "evaluation.toml").write_text(SIDE.replace(old, new))
    with pytest.raises((ConfigError, LogFolderError), match=problem), real_logs.opened(circle):
        pass


def beside(folder: str) -> Path:
    """The data of a real log, where it is at hand."""
    if not (DATA / folder).is_dir():
        pytest.skip(f"the log is not beside the project (../shared/data/{folder})")
    return DATA / folder


@pytest.mark.parametrize("folder", sorted(p.name for p in LOGS.iterdir()))
def test_every_manifest_is_valid(folder: str):
    log = open_log(LOGS / folder)
    assert log.name == folder
    side = LOGS / folder / real_logs.SIDE_FILE
    assert not side.exists() or "truth" in side.read_text()


@pytest.mark.parametrize("folder", sorted(p.name for p in LOGS.iterdir()))
def test_every_row_of_a_real_log_is_read(folder: str):
    with real_logs.opened(LOGS / folder, beside(folder)) as (log, _):
        sensors = {r.sensor for r in log.readings()}
        assert sensors == {s.name for s in log.machine.sensors if s.use}
        assert not log.refused


@pytest.mark.slow
def test_mower_against_its_truth():
    (row,) = run(LOGS / "plaza2_mower", (0.0, 1.0), data=beside("plaza2_mower"))["rows"]
    assert row["truth_net_m"] < 3.0  # one fix of the first receiver alone is off by 3.3 m
