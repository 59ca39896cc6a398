"""A foreign machine's log in real processes: fixes in metres, two wheels, Doppler, a headerless file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from protocol.wire.session import free_endpoint
from sitegrid.process.children import Children
from tests.command_lines import said
from tests.integration.site_run import SiteRun  # beside this file
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.processes

TRACK_M, SPEED_MPS = 0.6, 2.0
LOG = """
log = { name = "robot", start_ns = 1750000000000000000 }
machine = { name = "robot", wheel_radius_m = 0.1, load_centre_m = 0.0 }

[site]
name = "yard" # the log's frame has no place on Earth
origin_lat_deg = 50.0
origin_lon_deg = 8.0

[[sensor]]
name = "wheels"
kind = "odometry"
file = "wheels.txt"
names = ["s", "ns", "left", "right"]
delimiter = " "
[sensor.columns]
stamp = { columns = { s = 1.0, ns = 1e-9 } }
speed_x_mps = { columns = { left = 0.5, right = 0.5 }, unit = "km/h" }
rate_z_radps = { columns = { left = -0.46296, right = 0.46296 } } # 1 / (3.6 * 0.6)

[[sensor]]
name = "tracker"
kind = "gps"
file = "tracker.csv"
std = { position = 0.5 }
drift_share = 0.0
mount = { xyz_m = [0.5, 0.2, 0.0] }
delay_s = -0.1
columns = { stamp = "t", x_m = "east", y_m = "north" }

[[sensor]]
name = "doppler"
kind = "gps_velocity"
file = "tracker.csv"
std = { velocity = 0.2 }
mount = { xyz_m = [0.5, 0.2, 0.0] }
delay_s = -0.1
columns = { stamp = "t", speed_mps = "speed", course_deg = "course" }
"""


def write_log(folder: Path) -> np.ndarray:
    """A figure of eight in 80 s; returns the true track (n, 2)."""
    rng, dt = np.random.default_rng(7), 0.1
    t = np.arange(0, 80, dt)
    turn = 0.25 * np.where(t % 50 < 25, 1, -1)
    heading = np.cumsum(turn) * dt
    track = np.cumsum(SPEED_MPS * dt * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    left, right = (3.6 * (SPEED_MPS + side * turn * TRACK_M / 2) for side in (-1, 1))
    rows = zip(t, left, right, strict=True)
    lines = [f"{int(s)} {round(s % 1 * 1e9)} {v_l:.4f} {v_r:.4f}" for s, v_l, v_r in rows]
    (folder / "wheels.txt").write_text("# by the robot\n" + "\n".join(lines) + "\n")
    c, s = np.cos(heading), np.sin(heading)
    antenna = track + np.stack([0.5 * c - 0.2 * s, 0.5 * s + 0.2 * c], axis=1) + 0.5 * rng.standard_normal(track.shape)
    ahead, sideways = SPEED_MPS - 0.2 * turn, 0.5 * turn
    east, north = c * ahead - s * sideways, s * ahead + c * sideways
    speed, course = np.hypot(east, north), np.degrees(np.arctan2(east, north))
    rows = zip(t[::2] - 0.1, *antenna[::2].T, speed[::2], course[::2], strict=True)  # stamped 0.1 s early
    lines = [",".join(f"{value:.4f}" for value in row) for row in rows]
    (folder / "tracker.csv").write_text("t,east,north,speed,course\n" + "\n".join(lines) + "\n")
    (folder / "log.toml").write_text(LOG)
    site = LOG[LOG.index("[site]") : LOG.index("[[sensor]]")].replace("[site]\n", "")
    (folder / "site.toml").write_text(site)
    return track


def test_a_log_in_metres_is_located_and_mapped_where_the_machine_was(site_run: SiteRun, children: Children, tmp_path):
    track = write_log(tmp_path)
    site_run.site = "yard"
    site_run.start_router()
    server = site_run.start_server()
    words = ("--endpoint", site_run.endpoint, "--driver", "replay", "--log", tmp_path, "--speed", "0", "--json")
    files = ("--spool", tmp_path / "robot.db", "--audit", tmp_path / "robot.audit")
    report = children.start("robot", "agent", *words, *files).expect("ended", PATIENCE_S)["ended"]
    assert report["delivered"]
    assert report["samples"] > 200
    counters = report["pipeline"]["counters"]
    assert counters["tracker_used"] > 350
    assert counters["doppler_used"] > 350
    assert not [name for name in counters if name.startswith("log_")]
    with site_run.connect() as client:
        region = client.region((-40.0, -40.0, 60.0, 60.0), layers=["visits"])
    visited = np.argwhere(region.layers["visits"] > 0.5)
    places = np.stack([region.x_m[visited[:, 1]], region.y_m[visited[:, 0]]], axis=1)
    off_m = np.array([np.hypot(*(track - place).T).min() for place in places])
    assert len(places) > 60
    assert np.median(off_m) < 0.7
    assert np.quantile(off_m, 0.95) < 3.0
    server.stop()


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (
            'x_m = "east"',
            'x_m = "easting"',
            "tracker.csv: has no column `easting`; it has t, east, north, speed, course",
        ),
        ('x_m = "east"', 'x_m = { column = "east", offset = 4e5 }', "none of its rows can be used; line 2: x_m: 4000"),
        ('kind = "gps"\n', 'kind = "gps"\nmode = "differential"\n', "robot: no sensor in use shows its place"),
    ],
)
def test_a_log_that_cannot_be_run_is_one_line(tmp_path: Path, old: str, new: str, problem: str):
    write_log(tmp_path)
    assert old in LOG
    (tmp_path / "log.toml").write_text(LOG.replace(old, new, 1))
    words = ("--driver", "replay", "--log", tmp_path, "--spool", tmp_path / "x.db", "--endpoint", free_endpoint())
    for refused in (said("log", "run", tmp_path), said("agent", *words)):
        assert refused.code == 1
        (line,) = [line for line in refused.err.splitlines() if line.startswith("sitegrid:")]
        assert problem in line
