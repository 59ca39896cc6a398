"""`sitegrid log check` on realistic recordings."""

import gzip
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Odometry
from sitegrid.doctor import Level
from sitegrid.logs.check import LogCheck, examine
from sitegrid.logs.speeds import wheel_distance, wheel_share
from tests.unit.sitegrid.logs.data import MANIFEST, START_S, edit, write_circle

Rows = list[list[str]]


@pytest.fixture
def circle(tmp_path: Path) -> Path:
    return write_circle(tmp_path)


def said(examined: LogCheck, check: str) -> str:
    """All lines about a subject."""
    lines = [str(finding) for finding in examined.findings if finding.check == check]
    assert all("\n" not in line for line in lines)
    return "\n".join(lines)


def joined(rows: Rows) -> list[str]:
    return [",".join(row) for row in rows]


def test_a_sound_log_is_a_table_of_its_sensors_and_what_it_is_good_for(circle: Path) -> None:
    examined = examine(circle)
    assert examined.ok
    assert examined.begins == "2023-11-14 22:13:20 UTC"
    gps, wheels = examined.rows
    assert (gps["sensor"], gps["kind"], gps["usable"], gps["refused"]) == ("gps-1", "gps", 160, 0)
    assert (gps["begins_s"], gps["ends_s"], gps["rate_hz"], gps["gaps"]) == (0.0, 79.5, 2.0, 0)
    assert (wheels["rate_hz"], wheels["longest_gap_s"]) == (10.0, 0.1)
    assert [str(finding.level) for finding in examined.findings] == ["PASS", "-", "-"]
    assert said(examined, "positions") == "PASS  positions     by gps-1, wheels"


def replaced(column: int, value: Callable[[str], object]) -> Callable[[Rows], list[str]]:
    """Change all values of a column."""
    return lambda rows: joined([[*row[:column], str(value(row[column])), *row[column + 1 :]] for row in rows])


WRONG = {  # file, change, sensor, message
    "a gap": (
        "gps.csv",
        lambda rows: joined(rows[:5] + rows[60:]),
        "gps-1",
        "WARN.*gaps: 1, the longest of 28.0 s, 2 s",
    ),
    "a stamp of the future": (
        *("gps.csv", lambda rows: joined([["9e8", *rows[0][1:]], *rows[1:]]), "gps-1"),
        "WARN.*1 of 160 rows refused .stamp_ahead., first gps.csv line 2: t: it is 899999999.0 s ahead.*; no harm",
    ),
    "rounded stamps": ("gps.csv", replaced(0, lambda _: 9), "gps-1", "FAIL.*do not advance: 1 different in 160 rows"),
    "clocks from other days": (
        *("gps.csv", replaced(0, lambda t: float(t) + START_S), "gps-1"),
        "FAIL.*when no other sensor has any; write `delay_s = 1700000000.0` under its name",
    ),
    "clocks apart": (
        *("gps.csv", replaced(0, lambda t: float(t) + 18), "gps-1"),
        "WARN.*18.0 s ahead of those of wheels, by the motion; write `delay_s = 18.0` under its name",
    ),
    "a frozen fix": (
        "gps.csv",
        lambda rows: joined([[t, "9", "9"] for t, *_ in rows]),
        "gps-1",
        "WARN.*99% of its fixes",
    ),
    "another origin": ("gps.csv", replaced(1, lambda _: 30000), "gps-1", "FAIL.*100% of its fixes are more than 20 km"),
    "km/h": ("odom.csv", replaced(1, lambda v: 3.6 * float(v)), "wheels", "WARN.*turn 3.[567] times as far as gps-1"),
    "dead wheels": ("odom.csv", replaced(1, lambda _: 0), "wheels", "WARN.*stands while .* from .* to .* s; it is"),
}


@pytest.mark.parametrize(("file", "change", "subject", "line"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_with_a_file_is_one_line_that_says_what_to_do(
    circle: Path, file: str, change: Callable[[Rows], list[str]], subject: str, line: str
) -> None:
    edit(circle / file, change)
    lines = said(examine(circle), subject)
    assert re.search(f"^{line}", lines, re.MULTILINE), lines
    assert all("; " in one for one in lines.splitlines())


@pytest.mark.parametrize(
    ("old", "new", "subject", "line"),
    [
        (
            'file = "gps.csv"',
            'file = "fixes.csv"',
            "gps-1",
            r"FAIL.*fixes\.csv: is not there; `--data` names the folder",
        ),
        ('x_m = "x"', 'x_m = "east"', "gps-1", "FAIL.*has no column `east`; it has t, x, y"),
        (
            'kind = "odometry"\n',
            'kind = "odometry"\nuse = false\n',
            "positions",
            "WARN.*gps-1: none shows the turn; add a gyro",
        ),
        ('file = "gps.csv"', 'file = "gps.csv"\nuse = false', "positions", "FAIL.*no usable GPS fixes; .*--set start="),
        (
            'name = "wheels"',
            'name = "wheels"\nmeasures = ["speed"]',
            "positions",
            "WARN.*none shows the turn; add a gyro",
        ),
    ],
)
def test_what_a_manifest_lacks_for_positions_is_said(circle: Path, old: str, new: str, subject: str, line: str) -> None:
    assert old in MANIFEST
    (circle / "log.toml").write_text(MANIFEST.replace(old, new, 1))
    examined = examine(circle)
    assert re.search(f"^{line}", said(examined, subject)), examined.findings
    assert examined.ok == (not said(examined, "positions").startswith("FAIL"))


def test_a_compressed_log_that_lies_apart_from_its_manifest_is_read(circle: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for name in ("gps.csv", "odom.csv"):
        (data / f"{name}.gz").write_bytes(gzip.compress((circle / name).read_bytes()))
        (circle / name).unlink()
    (circle / "log.toml").write_text(MANIFEST.replace('.csv"', '.csv.gz"'))
    assert examine(circle / "log.toml", data).ok
    assert not examine(circle).ok


@pytest.mark.parametrize(
    ("side", "subject", "line"),
    [
        ("", "truth", r"-.*no true track is known; describe one as \[truth\] in evaluation.toml"),
        ('[truth]\nfile = "true.csv"\nstamp = "t"\nx_m = "x"\ny_m = "y"', "truth", "PASS"),
        ('[truth]\nfile = "lost.csv"\nstamp = "t"\nx_m = "x"\ny_m = "y"', "truth", "FAIL.*lost.csv: is not there"),
        (
            '[truth]\nfile = "late.csv"\nstamp = "t"\nx_m = "x"\ny_m = "y"',
            "truth",
            "FAIL.*from 900 to 901 s of the log",
        ),
        ("", "ground", "-.*no IMU with forces"),
    ],
)
def test_what_can_be_compared_is_said(circle: Path, side: str, subject: str, line: str) -> None:
    (circle / "evaluation.toml").write_text(side)
    (circle / "true.csv").write_text("t,x,y\n0,1,2\n1,2,3\n")
    (circle / "late.csv").write_text("t,x,y\n900,1,2\n901,2,3\n")
    assert re.match(line, said(examine(circle), subject))


def test_no_sensor_is_blamed_where_the_machine_only_stands(circle: Path) -> None:
    edit(circle / "gps.csv", lambda rows: joined([[t, f"{100 + i % 7 / 10}", "50"] for i, (t, *_) in enumerate(rows)]))
    edit(circle / "odom.csv", lambda rows: joined([[t, "0", "0"] for t, _, _ in rows]))
    assert not [finding for finding in examine(circle).findings if finding.level == Level.WARN]


TIMES = np.arange(0.0, 120.0, 0.1)


def driven(seed: int = 3) -> np.ndarray:
    """Distance of a drive with a new speed every 4 s."""
    speeds = np.repeat(np.random.default_rng(seed).choice([0.0, 1.0, 3.0, 5.0], len(TIMES) // 40), 40)
    return np.cumsum(speeds) * 0.1


def fixes(metres: np.ndarray, noise_m: float = 0.3) -> np.ndarray:
    return np.stack([metres, 0 * metres], axis=1) + np.random.default_rng(5).normal(0, noise_m, (len(metres), 2))


def test_a_steady_drive_shows_the_scale() -> None:
    share = wheel_share((TIMES, fixes(3.0 * TIMES)), (TIMES, 3.0 * TIMES))
    assert share == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.6])
def test_the_scale_of_wheels_is_that_of_their_distance(scale: float) -> None:
    share = wheel_share((TIMES, fixes(driven())), (TIMES, scale * driven()))
    assert share == pytest.approx(scale, rel=0.05)


def test_a_machine_that_stands_and_a_short_log_show_nothing() -> None:
    share = wheel_share((TIMES, fixes(0 * TIMES, noise_m=0.05)), (TIMES, 0 * TIMES))
    assert math.isnan(share)
    assert math.isnan(wheel_share((TIMES[:40], fixes(driven()[:40])), (TIMES[:40], driven()[:40])))


def test_ticks_and_speeds_are_the_same_way() -> None:
    """In reverse too: distance, not position."""
    encoder = SensorConfig("ticks", "encoder", ticks_per_rev=100)
    machine = MachineConfig("m", wheel_radius_m=0.5, sensors=(encoder,))
    per_tick_m = 2 * math.pi * 0.5 / 100
    ticks = [Encoder("ticks", 10**9 * i, t, t) for i, t in enumerate([0.0, 100.0, 50.0])]
    speeds = [
        Odometry("speed", 10**9 * i, v, 0.0, 0.0) for i, v in enumerate([0.0, 100 * per_tick_m, -50 * per_tick_m])
    ]
    for readings in (ticks, speeds):
        seconds, metres = wheel_distance(readings, machine)
        assert seconds.tolist() == [0.0, 1.0, 2.0]
        assert metres == pytest.approx([0.0, 100 * per_tick_m, 150 * per_tick_m])
