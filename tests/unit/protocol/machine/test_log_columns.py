"""Log columns and files: substitutes for a reading's columns, and file syntax."""

import math
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.readings import columns
from protocol.site.site_config import Projection

T0 = 1_750_000_000_000_000_000
MANIFEST = """
log = { name = "test", start_ns = 1_750_000_000_000_000_000 }
site = { name = "yard", origin_lat_deg = 49.0, origin_lon_deg = 8.4, origin_height_m = 110.0 }
machine = { name = "loader-1" }
[[sensor]]
name = "it"
kind = "KIND"
file = "it.csv"
KEYS
columns = COLUMNS
"""
METRES = 'x_m = "x", y_m = "y"'
STATED = 'var_e_m2 = "e", var_n_m2 = "n"'


def opened(folder: Path, text: str, kind: str, described: str, keys: str = "") -> LogFolder:
    (folder / "it.csv").write_text(text)
    described = described if described.startswith("{") else f'{{ stamp = "t", {described} }}'
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
    assert z == 0.0  # an unstated height is the origin's
    assert (fix.var_e_m2, fix.var_n_m2) == (2.0, 3.0)


def test_standard_deviations_in_any_unit_become_variances(tmp_path: Path) -> None:
    described = f'{METRES}, std_e_m = {{ column = "acc", unit = "mm" }}, std_n_m = {{ columns = {{ hdop = 2.5 }} }}'
    fix = only(opened(tmp_path, "t,x,y,acc,hdop\n1,2,3,1500,0.8\n", "gps", described))
    assert (fix.var_e_m2, fix.var_n_m2) == (pytest.approx(2.25), pytest.approx(4.0))


@pytest.mark.parametrize(
    ("row", "reason", "problem"),
    [
        ("1,350000,5427000,2", "out_of_range", "x_m: 350000.0 is not within 100 km of the site's origin"),
        ("1,nan,5,2", "not_finite", "x_m: nan is not within"),
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


@pytest.mark.parametrize(
    ("kind", "described", "quantity"),
    [
        ("gps", f'{METRES}, var_e_m2 = "v", var_n_m2 = "v"', "position"),
        ("gps", f'{METRES}, std_e_m = "v", std_n_m = "v"', "position"),
        ("gps_velocity", 'speed_mps = "x", course_deg = "y", var_e_m2ps2 = "v", var_n_m2ps2 = "v"', "velocity"),
    ],
)
def test_a_variance_that_is_not_known_is_that_of_std(tmp_path: Path, kind: str, described: str, quantity: str) -> None:
    """Drivers write 0 for unknown; stated ones stay, `std` replaces them later."""
    text = "t,x,y,v\n0,1,2,0\n1,1,2,0.0\n2,1,2,4\n"
    log = opened(tmp_path, text, kind, described, f"std = {{ {quantity} = 3.0 }}")
    variances = [
        [getattr(reading, name) for name in columns(kind) if name[:6] in ("var_e_", "var_n_")]
        for reading in log.readings()
    ]
    stated = 16.0 if "std_e_m" in described else 4.0
    assert variances == [[9.0, 9.0], [9.0, 9.0], [stated, stated]]
    without = opened(tmp_path, text, kind, described, "")
    assert len(list(without.readings())) == 1


@pytest.mark.parametrize(
    ("course", "east", "north"), [(0.0, 0.0, 2.0), (90.0, 2.0, 0.0), (225.0, -math.sqrt(2), -math.sqrt(2))]
)
def test_speed_and_course_become_a_velocity(tmp_path: Path, course: float, east: float, north: float) -> None:
    """In a receiver's units: knots, degrees clockwise from north."""
    described = 'speed_mps = { column = "kn", unit = "kn" }, course_deg = "course"'
    text = f"t,kn,course\n1,{2 * 3600 / 1852},{course}\n"
    velocity = only(opened(tmp_path, text, "gps_velocity", described, "std = { velocity = 0.2 }"))
    assert (velocity.velocity_e_mps, velocity.velocity_n_mps) == pytest.approx((east, north), abs=1e-12)
    assert (velocity.var_e_m2ps2, velocity.var_n_m2ps2) == pytest.approx((0.04, 0.04))


# --- other kinds -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "keys", "described", "expected"),
    [
        ("odometry", "", 'speed_x_mps = "a", rate_z_radps = "b"', {"speed_x_mps": 1.0, "rate_z_radps": 2.0}),
        ("odometry", 'measures = ["speed"]', 'speed_x_mps = "a"', {"speed_x_mps": 1.0, "speed_y_mps": 0.0}),
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
        ("gps", "", METRES, "nor `std_e_m`, nor `std = { position = ... }` of the sensor"),
        ("gps", "", f'{METRES}, std_e_m = "e"', "column `var_n_m2` is not described, nor `std_n_m`"),
        ("gps_velocity", "std = { velocity = 0.1 }", 'speed_mps = "v"', "column `course_deg` is not described"),
    ],
)
def test_what_is_missing_or_there_twice_is_refused_by_name(
    tmp_path: Path, kind: str, keys: str, described: str, problem: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, "", kind, described, keys)
    assert problem in str(caught.value)
    assert "[[sensor]] 1" in str(caught.value)


# --- files, and columns of wheels ------------------------------------------------------------------------------------

WHEELS = '{ stamp = "t", speed_x_mps = "v", rate_z_radps = "w" }'


def wheels(folder: Path, text: str, keys: str = "", columns: str = WHEELS) -> LogFolder:
    return opened(folder, text, "odometry", columns, keys)


def speeds(log: LogFolder) -> list[tuple[float, float]]:
    return [(reading.speed_x_mps, reading.rate_z_radps) for reading in log.readings()]


def test_a_speed_is_the_mean_of_wheels_and_a_turn_is_their_difference_over_the_track(tmp_path: Path) -> None:
    columns = """{ stamp = "t", speed_x_mps = { columns = { l = 0.5, r = 0.5 }, unit = "km/h" },
        rate_z_radps = { columns = { r = 0.2, l = -0.2 } } }"""
    made = speeds(wheels(tmp_path, "t,l,r\n0,3.6,7.2\n", columns=columns.replace("\n", " ")))
    assert made == [(pytest.approx(1.5), pytest.approx(0.72))]


def test_an_offset_counts_in_the_unit_of_the_file(tmp_path: Path) -> None:
    """A bus's raw value: 0.1 km/h per step from -40 km/h."""
    columns = WHEELS.replace('"v"', '{ columns = { v = 0.1 }, offset = -40.0, unit = "km/h" }')
    made = speeds(wheels(tmp_path, "t,v,w\n0,436,0\n1,400,0\n", columns=columns))
    assert [v for v, _ in made] == pytest.approx([1.0, 0.0])
    turned = WHEELS.replace('"v"', '{ column = "v", offset = 2.0 }')
    assert speeds(wheels(tmp_path, "t,v,w\n0,1,0\n", columns=turned)) == [(3.0, 0.0)]


@pytest.mark.parametrize(("seconds", "nanoseconds"), [("1", "5"), ("12", "999999999"), ("0", "000000007")])
def test_seconds_and_nanoseconds_of_two_columns_are_exact(tmp_path: Path, seconds: str, nanoseconds: str) -> None:
    columns = WHEELS.replace('"t"', "{ columns = { s = 1.0, ns = 1e-9 } }")
    log = wheels(tmp_path, f"s,ns,v,w\n{seconds},{nanoseconds},1,0\n", columns=columns)
    assert [r.stamp_ns for r in log.readings()] == [T0 + int(seconds) * 10**9 + int(nanoseconds)]


@pytest.mark.parametrize(
    ("column", "problem"),
    [
        ("{ columns = { t = 1e-10 } }", "no whole number of nanoseconds"),
        ("{ column = 't', offset = 3.0 }", "times count from `start_ns`"),
        ("{ value = 3.0 }", "a column is expected"),
        ("{ columns = { t = 0.0 } }", "other than 0"),
        ("{ columns = { t = 1.0 }, column = 't' }", "write"),
    ],
)
def test_a_time_that_cannot_be_is_refused_by_name(tmp_path: Path, column: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        wheels(tmp_path, "", columns=WHEELS.replace('"t"', column))
    assert "[[sensor]] 1 columns.stamp" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "after_ns"),
    [
        ("2025-06-15T15:06:40Z", 0),
        ("2025-06-15 17:06:40,25+02:00 ", 250_000_000),
        ("20250615T150640.000000001Z", 1),
    ],
)
def test_times_with_their_zone_are_exact_and_count_from_no_start(tmp_path: Path, text: str, after_ns: int) -> None:
    columns = WHEELS.replace('"t"', '{ column = "t", unit = "iso" }')
    log = wheels(tmp_path, f't,v,w\n"{text}",1,0\n', columns=columns)
    assert [r.stamp_ns for r in log.readings()] == [T0 + after_ns]


@pytest.mark.parametrize(
    ("lat", "lon", "row", "place"),
    [
        ("", "", "4901.5N,00824.75 E", (49.025, 8.4125)),
        ("", "", "-4901.5,824.75W", (-49.025, -8.4125)),
        (', side = "ns"', ', side = "ew"', "4901.5,824.75,S,W", (-49.025, -8.4125)),
    ],
)
def test_positions_may_be_degrees_and_minutes(
    tmp_path: Path, lat: str, lon: str, row: str, place: tuple[float, float]
) -> None:
    fix = only(opened(tmp_path, f"t,lat,lon,ns,ew\n1,{row}\n", "gps", DDMM % (lat, lon), "std = { position = 1.0 }"))
    assert (fix.lat_deg, fix.lon_deg) == pytest.approx(place, abs=1e-12)


DDMM = 'lat_deg = { column = "lat", unit = "ddmm"%s }, lon_deg = { column = "lon", unit = "ddmm"%s }'


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("2025-06-15T15:06:40,4901.5,824.75", "line 2: t: '2025-06-15T15:06:40' names no zone, as Z or +02:00"),
        ("yesterday,4901.5,824.75", "line 2: t: 'yesterday' is no time in ISO 8601"),
        ("2025-06-15T15:06:40Z,4961.5,824.75", "line 2: lat: '4961.5' is not ddmm.mmmm, with minutes below 60"),
        ("2025-06-15T15:06:40Z,4901.5E,824.75", "line 2: lat: '4901.5E' is on side 'E', not N or S"),
        ("2025-06-15T15:06:40Z,4901.5,", "line 2: lon: a value is missing"),
        ("2025-06-15T15:06:40Z,9901.5,824.75", "is not between -90 and 90 (`lat` has '9901.5')"),
    ],
)
def test_a_text_that_is_no_time_or_position_is_refused_with_column_row_and_value(
    tmp_path: Path, row: str, problem: str
) -> None:
    described = '{ stamp = { column = "t", unit = "iso" }, ' + DDMM % ("", "") + " }"
    log = opened(tmp_path, f"t,lat,lon\n{row}\n", "gps", described, "std = { position = 1.0 }")
    with pytest.raises(LogFolderError) as caught:
        list(log.readings())
    assert problem in str(caught.value)
    assert "it.csv: none of its rows can be used; line 2: " in str(caught.value)


@pytest.mark.parametrize(
    "described",
    [
        f'{{ stamp = {{ column = "t", unit = "iso", offset = 1.0 }}, {METRES} }}',
        '{ stamp = "t", x_m = { column = "x", unit = "ddmm" }, y_m = "y" }',
        '{ stamp = "t", lat_deg = { columns = { x = 2.0 }, unit = "ddmm" }, lon_deg = "y" }',
        '{ stamp = "t", lat_deg = { column = "x", side = "ns" }, lon_deg = "y" }',
    ],
)
def test_a_unit_of_texts_that_does_not_fit_is_refused(tmp_path: Path, described: str) -> None:
    with pytest.raises(ConfigError, match=r"unit `(iso|ddmm)`"):
        opened(tmp_path, "", "gps", described, "std = { position = 1.0 }")


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ("", "t,v,w\n0,1,0.5\n1,2,0.25\n"),
        ('delimiter = ";"', "t;v;w\n0;1;0.5\n1;2;0.25\n"),
        ('delimiter = "\\t"', "t\tv\tw\n0\t1\t0.5\n1\t2\t0.25\n"),
        ('delimiter = " "', "t v  w\n0  1 0.5 \n 1\t2   0.25\n"),
        ('names = ["t", "v", "w"]', "0,1,0.5\n1,2,0.25\n"),
        ('names = ["t", "v", "w"]\ndelimiter = " "', "# by a robot\n# t v w\n0 1 0.5\n\n1 2 0.25\n"),
        ("at_least = { mode = 2 }", "t,v,w,mode\n0,1,0.5,3\n0.5,9,9,1\n0.6,9,9,nan\n1,2,0.25,2\n"),
    ],
)
def test_files_of_other_shapes_hold_the_same(tmp_path: Path, keys: str, text: str) -> None:
    log = wheels(tmp_path, text, keys)
    assert speeds(log) == [(1.0, 0.5), (2.0, 0.25)]
    assert dict(log.refused) == ({"below_least": 2} if "mode" in text else {})


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ('delimiter = "|"', "'|' is none of"),
        ('names = ["t", "t"]', "'t' is empty, or stands there twice"),
        ('names = ["t", ""]', "'' is empty"),
    ],
)
def test_a_file_that_cannot_be_is_refused_by_name(tmp_path: Path, keys: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        wheels(tmp_path, "", keys)
    assert problem in str(caught.value)


def test_blanks_around_a_delimiter_belong_neither_to_a_name_nor_to_a_value(tmp_path: Path) -> None:
    log = wheels(tmp_path, 't , v," w "\n0 , 1 , 0\n1, "2", 0 \n')
    assert speeds(log) == [(1.0, 0.0), (2.0, 0.0)]
    assert not log.refused


def test_the_first_bad_row_of_each_reason_is_named_with_its_line(tmp_path: Path) -> None:
    text = "# a comment\n0 1 0.5\n1 x 0.5\n2 y 0.5\n\n3 500 0\n2 1 0\n1 1 0\n"
    log = wheels(tmp_path, text, 'names = ["t", "v", "w"]\ndelimiter = " "')
    assert len(speeds(log)) == 2
    assert log.refused == {"wrong_type": 2, "out_of_range": 1, "stamp_goes_back": 1}
    assert log.first_refused == {
        "wrong_type": "it.csv line 3: v: 'x' is not a number",
        "out_of_range": "it.csv line 6: it.speed_x_mps: 500.0 is not between -100 and 100 (`v` has '500')",
        "stamp_goes_back": "it.csv line 8: t: it is 1.0 s behind the rows around it",
    }
