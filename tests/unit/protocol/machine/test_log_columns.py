"""What a log may have in place of a reading's own columns, and what it need not have."""

import math
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_columns import std_name
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.readings import KINDS, columns
from protocol.site.site_config import Projection
from protocol.units import factor

MANIFEST = """
log = { name = "test", start_ns = 1750000000000000000 }
site = { name = "yard", origin_lat_deg = 49.0, origin_lon_deg = 8.4, origin_height_m = 110.0 }
machine = { name = "loader-1" }
[[sensor]]
name = "it"
kind = "KIND"
file = "it.csv"
KEYS
columns = { stamp = "t", COLUMNS }
"""
METRES = 'x_m = "x", y_m = "y"'
STATED = 'var_e_m2 = "e", var_n_m2 = "n"'


def opened(folder: Path, text: str, kind: str, described: str, keys: str = "") -> LogFolder:
    (folder / "it.csv").write_text(text)
    manifest = MANIFEST.replace("KIND", kind).replace("KEYS", keys).replace("COLUMNS", described)
    (folder / "log.toml").write_text(manifest)
    return open_log(folder)


def only(log: LogFolder) -> Any:
    (reading,) = log.readings()
    return reading


# --- GPS -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [(0.0, 0.0), (-34.2086, 45.3008), (1234.5, -6789.25), (90_000.0, -90_000.0)])
def test_fixes_in_metres_come_back_as_the_metres_that_they_were(tmp_path: Path, place: tuple[float, float]) -> None:
    log = opened(tmp_path, f"t,x,y,e,n\n1,{place[0]},{place[1]},2,3\n", "gps", f"{METRES}, {STATED}")
    fix = only(log)
    x, y, z = Projection(log.site).to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
    assert (x, y) == pytest.approx(place, abs=1e-5)
    assert z == 0.0  # a height that nobody states is the origin's
    assert (fix.var_e_m2, fix.var_n_m2) == (2.0, 3.0)


def test_a_receiver_that_states_no_variance_has_a_std_instead(tmp_path: Path) -> None:
    fix = only(opened(tmp_path, "t,x,y\n1,2,3\n", "gps", METRES, "std = { position = 2.5 }"))
    assert (fix.var_e_m2, fix.var_n_m2) == (6.25, 6.25)


def test_standard_deviations_in_any_unit_become_variances(tmp_path: Path) -> None:
    described = f'{METRES}, std_e_m = {{ column = "acc", unit = "mm" }}, std_n_m = {{ columns = {{ hdop = 2.5 }} }}'
    fix = only(opened(tmp_path, "t,x,y,acc,hdop\n1,2,3,1500,0.8\n", "gps", described))
    assert (fix.var_e_m2, fix.var_n_m2) == (pytest.approx(2.25), pytest.approx(4.0))


@pytest.mark.parametrize(
    ("row", "reason", "problem"),
    [
        ("1,350000,5427000,2", "out_of_range", "x_m: 350000.0 is not within 100 km of the site's origin"),
        ("1,nan,5,2", "not_finite", "x_m: nan is not within"),
        ("1,4,-inf,2", "not_finite", "y_m: -inf is not within"),
        ("1,4,5,-2", "out_of_range", "std_e_m: -2.0 is negative"),
        ("1,4,5,nan", "not_finite", "it.var_e_m2: nan is not between"),
        ("1,4,5,0", "out_of_range", "it.var_e_m2: 0.0 is not between"),
    ],
)
def test_a_value_that_cannot_be_is_refused_with_its_line(tmp_path: Path, row: str, reason: str, problem: str) -> None:
    described = f'{METRES}, std_e_m = "s", std_n_m = "s"'
    log = opened(tmp_path, f"t,x,y,s\n0,1,2,1\n{row}\n", "gps", described)
    assert len(list(log.readings())) == 1
    assert log.refused == {reason: 1}
    assert log.first_refused[reason].startswith(f"it.csv line 3: {problem}")


def test_metres_that_count_from_elsewhere_are_refused_as_a_whole(tmp_path: Path) -> None:
    text = "t,x,y\n" + "".join(f"{i},{350_000 + i},5427000\n" for i in range(5))
    log = opened(tmp_path, text, "gps", METRES, "std = { position = 2.0 }")
    with pytest.raises(LogFolderError, match=r"it\.csv: none of its rows can be used; line 2: x_m: 350000\.0"):
        list(log.readings())


@pytest.mark.parametrize(
    ("course", "east", "north"), [(0.0, 0.0, 2.0), (90.0, 2.0, 0.0), (225.0, -math.sqrt(2), -math.sqrt(2))]
)
def test_speed_and_course_become_a_velocity(tmp_path: Path, course: float, east: float, north: float) -> None:
    """As a receiver states them: knots, and degrees clockwise from north."""
    described = 'speed_mps = { column = "kn", unit = "kn" }, course_deg = "course"'
    text = f"t,kn,course\n1,{2 * 3600 / 1852},{course}\n"
    velocity = only(opened(tmp_path, text, "gps_velocity", described, "std = { velocity = 0.2 }"))
    assert (velocity.velocity_e_mps, velocity.velocity_n_mps) == pytest.approx((east, north), abs=1e-12)
    assert (velocity.var_e_m2ps2, velocity.var_n_m2ps2) == pytest.approx((0.04, 0.04))


def test_a_velocity_has_the_standard_deviations_that_its_receiver_states(tmp_path: Path) -> None:
    mm = ', unit = "mm/s" }'
    described = f"""velocity_e_mps = {{ column = "e"{mm}, velocity_n_mps = {{ column = "n"{mm},
        std_e_mps = {{ column = "acc"{mm}, std_n_mps = {{ column = "acc"{mm}""".replace("\n", " ")
    velocity = only(opened(tmp_path, "t,e,n,acc\n1,1500,-250,300\n", "gps_velocity", described))
    assert (velocity.velocity_e_mps, velocity.velocity_n_mps) == pytest.approx((1.5, -0.25))
    assert (velocity.var_e_m2ps2, velocity.var_n_m2ps2) == pytest.approx((0.09, 0.09))


# --- other kinds -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "keys", "described", "expected"),
    [
        ("odometry", "", 'speed_x_mps = "a", rate_z_radps = "b"', {"speed_x_mps": 1.0, "rate_z_radps": 2.0}),
        ("odometry", 'measures = ["speed"]', 'speed_x_mps = "a"', {"speed_x_mps": 1.0, "speed_y_mps": 0.0}),
        ("odometry", 'measures = ["rate"]', 'rate_z_radps = "b"', {"rate_z_radps": 2.0, "speed_x_mps": 0.0}),
        (
            "imu",
            'measures = ["rate"]',
            'gyro_x_radps = { value = 0.0 }, gyro_y_radps = { value = 0.0 }, gyro_z_radps = "a"',
            {"gyro_z_radps": 1.0, "force_z_mps2": 0.0},
        ),
        (
            "attitude",
            "std = { tilt = 0.1, heading = 0.2 }",
            "qx = { value = 0.0 }, qy = { value = 0.0 }, qz = { value = 0.0 }, qw = { value = 1.0 }",
            {"var_roll_rad2": pytest.approx(0.01), "var_yaw_rad2": pytest.approx(0.04)},
        ),
        (
            "attitude",
            'measures = ["tilt"]\nstd = { tilt = 0.1 }',
            "qx = { value = 0.0 }, qy = { value = 0.0 }, qz = { value = 0.0 }, qw = { value = 1.0 }",
            {"var_yaw_rad2": 1.0},
        ),
    ],
)
def test_columns_of_what_a_sensor_does_not_measure_need_not_be_there(
    tmp_path: Path, kind: str, keys: str, described: str, expected: dict[str, float]
) -> None:
    reading = only(opened(tmp_path, "t,a,b\n1,1,2\n", kind, described, keys))
    assert {name: getattr(reading, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("kind", "keys", "described", "problem"),
    [
        ("gps", "", f'{METRES}, lat_deg = "a", {STATED}', "`lat_deg` and `x_m` are described"),
        ("gps", "", f'x_m = "x", {STATED}', "column `y_m` is not described; `x_m` needs it"),
        ("gps", "", STATED, "column `lat_deg` is not described, nor `x_m`"),
        ("gps", "", f'{METRES}, {STATED}, std_e_m = "e"', "`var_e_m2` and `std_e_m` are described"),
        ("gps", "", METRES, "nor `std_e_m`, nor `std = { position = ... }` of the sensor"),
        ("gps", "", f'{METRES}, std_e_m = "e"', "column `var_n_m2` is not described, nor `std_n_m`"),
        (
            "gps",
            "",
            f'{METRES}, {STATED}, x_mm = "x"',
            "unknown column `x_mm`; a gps has stamp, lat_deg, lon_deg, height_m",
        ),
        ("gps", "", f'{STATED}, x_m = {{ column = "x", unit = "deg" }}, y_m = "y"', "`deg` does not fit `x_m`"),
        ("gps_velocity", "std = { velocity = 0.1 }", 'speed_mps = "v"', "column `course_deg` is not described"),
        ("odometry", "", 'speed_x_mps = "a"', "column `rate_z_radps` is not described"),
        ("imu", "", 'x_m = "x"', "unknown column `x_m`; a imu has stamp, gyro_x_radps"),
    ],
)
def test_what_is_missing_or_there_twice_is_refused_by_name(
    tmp_path: Path, kind: str, keys: str, described: str, problem: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, "", kind, described, keys)
    assert problem in str(caught.value)
    assert "[[sensor]] 1" in str(caught.value)


def test_every_variance_has_a_standard_deviation_in_a_unit_that_is_known():
    names = [name for kind in KINDS for name in columns(kind) if name.startswith("var_")]
    assert len(names) == 8
    assert all(
        factor({"_m": "m", "_mps": "m/s", "_rad": "rad"}["_" + std_name(n).split("_")[-1]], std_name(n)) == 1
        for n in names
    )
