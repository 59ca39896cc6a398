"""Replays of synthetic and real logs: withheld fixes, truth, choice of sensors."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import open_log
from sitegrid.logs import run as replayed
from sitegrid.logs.log_truth import read_log_truth
from sitegrid.logs.outages import WITHHOLD, Outage, Pattern, Periodic
from sitegrid.logs.sensors import UnsupportedError, chosen
from sitegrid.proof.figures import Report
from tests.paths import ROOT
from tests.paths import SHARED_DATA as DATA

LOGS = ROOT / "lab" / "logs"
MANIFEST = """
log = { name = "circle", start_ns = 1700000000000000000 }
site = { name = "yard", origin_lat_deg = 50.0, origin_lon_deg = 8.0 }
machine = { name = "mower" }
[[sensor]]
name = "wheels"
kind = "odometry"
file = "odom.csv"
columns = { stamp = "t", speed_x_mps = "v", rate_z_radps = "w" }
[[sensor]]
name = "gyro"
kind = "imu"
measures = ["rate"]
file = "odom.csv"
[sensor.columns]
stamp = "t"
gyro_x_radps = { value = 0.0 }
gyro_y_radps = { value = 0.0 }
gyro_z_radps = "w"
"""
GPS = """
[[sensor]]
name = "gps-{i}"
kind = "gps"
file = "gps{i}.csv"
use = {use}
std = {{ position = 1.0 }}
columns = {{ stamp = "t", x_m = "x", y_m = "y" }}
"""
SIDE = 'truth = { file = "truth.csv", stamp = "t", x_m = "east", y_m = "north" }'
RADIUS_M, RATE_RADPS = 20.0, 0.1


def at(t: float, off_m: float = 0.0) -> tuple[float, float]:
    """On a circle about (100, 50), off_m further east."""
    return 100 + RADIUS_M * math.cos(RATE_RADPS * t) + off_m, 50 + RADIUS_M * math.sin(RATE_RADPS * t)


def write(path: Path, names: str, rows: list[tuple[float, ...]]) -> None:
    path.write_text("\n".join([names, *(",".join(f"{v:.6f}" for v in row) for row in rows)]) + "\n")


@pytest.fixture
def circle(tmp_path: Path) -> Path:
    """A log of 100 s with GPS 2 m too far east: truth and fixes differ by that."""
    times = np.arange(0, 100, 0.1)
    write(tmp_path / "odom.csv", "t,v,w", [(t, RADIUS_M * RATE_RADPS, RATE_RADPS) for t in times])
    write(tmp_path / "truth.csv", "t,east,north", [(t, *at(t)) for t in times])
    write(tmp_path / "gps1.csv", "t,x,y", [(t, *at(t, 2.0)) for t in times[::2]])
    write(tmp_path / "gps2.csv", "t,x,y", [])
    gps = [GPS.format(i=i, use=use) for i, use in ((1, "true"), (2, "false"))]
    (tmp_path / "log.toml").write_text("".join([MANIFEST, *gps]))
    (tmp_path / "evaluation.toml").write_text(SIDE)
    return tmp_path


def run(folder: Path, *patterns: Pattern, data: Path | None = None, **choice: Any) -> Report:
    options, choose = LocalisationConfig(filter="ekf"), partial(chosen, **choice)
    return replayed.run(replayed.read_recording(folder, data, choose), options, patterns or WITHHOLD)


@pytest.mark.slow
def test_errors_against_fixes_and_against_truth_stand_apart(circle: Path):
    none, often = run(circle, None, Periodic(30.0, 10.0))["rows"]
    assert (none["withhold"], none["fixes"], none["rms_m"]) == ("none", 0, None)
    assert (often["withhold"], often["fixes"]) == ("10/30", 100)  # 5 Hz for 10 s in 30, from 40 s on
    assert often["rms_m"] < 0.8
    for row in (none, often):
        assert row["truth_net_m"] == pytest.approx(2.0, abs=0.6)
        assert row["truth_rmse_x_m"] == pytest.approx(2.0, abs=0.6)
        assert row["truth_rmse_y_m"] < 0.8
        assert row["truth_known"] == 1.0
        assert row["truth_nees_95"][0] < 2 < row["truth_nees_95"][1]
        assert 0 <= row["truth_coverage95"] <= 1
    assert often["truth_withheld_m"] == pytest.approx(2.0, abs=0.6)
    assert often["truth_end_m"] == pytest.approx(2.0, abs=0.6)
    assert math.isnan(none["truth_withheld_m"])
    assert none["covered"] > often["covered"] > 0.7


@pytest.mark.slow
def test_an_outage_is_placed_and_judged_wherever_it_is(circle: Path):
    """Wheels a tenth too large: the error grows without fixes."""
    rows = (circle / "odom.csv").read_text().splitlines()
    grown = [
        line.replace(f",{RADIUS_M * RATE_RADPS:.6f},", f",{RADIUS_M * RATE_RADPS * (1.1 if i > 300 else 1):.6f},")
        for i, line in enumerate(rows)
    ]
    (circle / "odom.csv").write_text("\n".join(grown) + "\n")
    early, short, long = run(circle, Outage(20.0, 5.0), Outage(30.0, 5.0), Outage(30.0, 25.0))["rows"]
    assert [row["withhold"] for row in (early, short, long)] == ["20,5", "30,5", "30,25"]
    assert [row["fixes"] for row in (early, short, long)] == [25, 25, 125]
    assert long["end_m"] > 2 * short["end_m"]
    assert long["end_m"] > 2 * early["end_m"]
    assert long["rms_m"] < long["end_m"] <= long["max_m"]


@pytest.mark.slow
def test_bad_rows_are_named_with_their_lines_and_measurements_are_counted_by_sensor(circle: Path):
    with (circle / "gps1.csv").open("a") as file:
        file.write("200,nan,1\n")
    report = run(circle, None)
    assert report["refused"] == {"not_finite": 1}
    assert report["first_refused"]["not_finite"].startswith("gps1.csv line 502: x_m: nan is not within 100 km")
    listed = {row["measurement"]: row for row in replayed.measurements(report["rows"])}
    assert set(listed) == {"gps-1", "gyro", "wheels"}
    assert listed["gps-1"]["used"] > 400
    assert listed["gps-1"]["nis"] is not None
    assert listed["wheels"]["nis"] is None


# --- what is chosen --------------------------------------------------------------------------------------------------


def test_sensors_are_chosen_by_name_and_receivers_by_number_too(circle: Path):
    machine = open_log(circle).machine

    def used(**choice: Any) -> list[str]:
        return [sensor.name for sensor in chosen(machine, **choice).sensors if sensor.use]

    assert used() == ["wheels", "gyro", "gps-1"]
    assert used(gps=2) == ["wheels", "gyro", "gps-1", "gps-2"]
    assert used(gps=("gps-2",)) == ["wheels", "gyro", "gps-2"]
    assert used(sensors=("gps-2", "wheels")) == ["wheels", "gps-2"]
    assert used(sensors=("gps-1", "gps-2", "wheels"), gps=1) == ["wheels", "gps-1"]
    assert replayed.receivers(chosen(machine, gps=2)) == 2


@pytest.mark.parametrize(
    ("choice", "problem"),
    [
        ({"gps": ("gps-9",)}, "mower: has no 'gps-9', but gps-1, gps-2"),
        ({"gps": 3}, "mower has 2 GPS receivers, not 3"),
        ({"sensors": ("wheels", "gyro")}, "mower: no sensor in use shows its place"),
        ({"gps": ("gps-2",), "sensors": ("gps-2",)}, "no sensor in use has a reading"),
    ],
)
def test_what_cannot_be_chosen_is_refused_in_one_line(circle: Path, choice: dict[str, Any], problem: str):
    with pytest.raises((ConfigError, LogFolderError, UnsupportedError)) as caught:
        run(circle, None, **choice)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def beside(folder: str) -> Path:
    """A real log's data, if at hand."""
    if not (DATA / folder).is_dir():
        pytest.skip(f"the log is not beside the project (../shared/data/{folder})")
    return DATA / folder


@pytest.mark.parametrize("folder", sorted(p.name for p in LOGS.iterdir()))
def test_every_row_of_a_real_log_is_read(folder: str):
    log = open_log(LOGS / folder, beside(folder))
    sensors = {r.sensor for r in log.readings()}
    assert sensors == {s.name for s in log.machine.sensors if s.use}
    assert not log.refused
    truth = read_log_truth(log, LOGS / folder)
    assert (truth is not None) == (folder == "plaza2_mower")
