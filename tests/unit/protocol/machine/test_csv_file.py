"""CSV files as loggers write them: without names, with other delimiters, with a value spread over columns."""

from pathlib import Path

import pytest

from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import LogFolder, open_log

T0 = 1_750_000_000_000_000_000
MANIFEST = f"""
log = {{ name = "test", start_ns = {T0} }}
site = {{ name = "yard", origin_lat_deg = 49.0, origin_lon_deg = 8.4 }}
machine = {{ name = "loader-1" }}
[[sensor]]
name = "wheels"
kind = "odometry"
file = "wheels.csv"
KEYS
columns = COLUMNS
"""
COLUMNS = '{ stamp = "t", speed_x_mps = "v", rate_z_radps = "w" }'


def opened(folder: Path, text: str, keys: str = "", columns: str = COLUMNS) -> LogFolder:
    (folder / "wheels.csv").write_text(text)
    (folder / "log.toml").write_text(MANIFEST.replace("KEYS", keys).replace("COLUMNS", columns))
    return open_log(folder)


def speeds(log: LogFolder) -> list[tuple[float, float]]:
    return [(reading.speed_x_mps, reading.rate_z_radps) for reading in log.readings()]


# --- values ----------------------------------------------------------------------------------------------------------


def test_a_speed_is_the_mean_of_wheels_and_a_turn_is_their_difference_over_the_track(tmp_path: Path) -> None:
    columns = """{ stamp = "t", speed_x_mps = { columns = { l = 0.5, r = 0.5 }, unit = "km/h" },
        rate_z_radps = { columns = { r = 0.2, l = -0.2 } } }"""
    made = speeds(opened(tmp_path, "t,l,r\n0,3.6,7.2\n", columns=columns.replace("\n", " ")))
    assert made == [(pytest.approx(1.5), pytest.approx(0.72))]


def test_an_offset_counts_in_the_unit_of_the_file(tmp_path: Path) -> None:
    """A raw value of a bus: 0.1 km/h a step, counted from -40 km/h."""
    columns = COLUMNS.replace('"v"', '{ columns = { v = 0.1 }, offset = -40.0, unit = "km/h" }')
    made = speeds(opened(tmp_path, "t,v,w\n0,436,0\n1,400,0\n", columns=columns))
    assert [v for v, _ in made] == pytest.approx([1.0, 0.0])
    turned = COLUMNS.replace('"v"', '{ column = "v", offset = 2.0 }')
    assert speeds(opened(tmp_path, "t,v,w\n0,1,0\n", columns=turned)) == [(3.0, 0.0)]


@pytest.mark.parametrize(("seconds", "nanoseconds"), [("1", "5"), ("12", "999999999"), ("0", "000000007")])
def test_seconds_and_nanoseconds_of_two_columns_are_exact(tmp_path: Path, seconds: str, nanoseconds: str) -> None:
    columns = COLUMNS.replace('"t"', "{ columns = { s = 1.0, ns = 1e-9 } }")
    log = opened(tmp_path, f"s,ns,v,w\n{seconds},{nanoseconds},1,0\n", columns=columns)
    assert [r.stamp_ns for r in log.readings()] == [T0 + int(seconds) * 10**9 + int(nanoseconds)]


@pytest.mark.parametrize(
    ("column", "problem"),
    [
        ("{ columns = { t = 1e-10 } }", "no whole number of nanoseconds"),
        ("{ columns = { t = 0.3 }, unit = 'ns' }", "no whole number of nanoseconds"),
        ("{ column = 't', offset = 3.0 }", "times count from `start_ns`"),
        ("{ value = 3.0 }", "a column is expected"),
        ("{ columns = {} }", "other than 0"),
        ("{ columns = { t = 0.0 } }", "other than 0"),
        ("{ columns = { t = 1.0 }, column = 't' }", "write"),
        ("{ column = 't', scale = 2.0 }", "unknown key `scale`"),
    ],
)
def test_a_time_that_cannot_be_is_refused_by_name(tmp_path: Path, column: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        opened(tmp_path, "", columns=COLUMNS.replace('"t"', column))
    assert "[[sensor]] 1 columns.stamp" in str(caught.value)


def test_a_constant_has_no_offset(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"columns\.rate_z_radps: write"):
        opened(tmp_path, "", columns=COLUMNS.replace('"w"', "{ value = 0.0, offset = 1.0 }"))


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
    log = opened(tmp_path, text, keys)
    assert speeds(log) == [(1.0, 0.5), (2.0, 0.25)]
    assert dict(log.refused) == ({"below_least": 2} if "mode" in text else {})


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ('delimiter = "|"', "'|' is none of"),
        ('delimiter = ""', "is none of"),
        ('names = ["t", "t"]', "'t' is empty, or stands there twice"),
        ('names = ["t", ""]', "'' is empty"),
        ("at_least = { mode = 'fix' }", "float is expected"),
    ],
)
def test_a_file_that_cannot_be_is_refused_by_name(tmp_path: Path, keys: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, "", keys)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "columns", "problem"),
    [
        ("at_least = { mode = 2 }", COLUMNS, "has no column `mode`; it has t, v, w"),
        ("", COLUMNS.replace('"v"', "{ columns = { v = 0.5, u = 0.5 } }"), "has no column `u`; it has t, v, w"),
        ('names = ["t", "v"]', COLUMNS, "has no column `w`; it has t, v"),
    ],
)
def test_a_column_that_is_not_there_is_named_with_those_that_are(
    tmp_path: Path, keys: str, columns: str, problem: str
) -> None:
    log = opened(tmp_path, "t,v,w\n0,1,0\n", keys, columns)
    with pytest.raises(LogFolderError) as caught:
        list(log.readings())
    assert str(caught.value) == f"{tmp_path / 'wheels.csv'}: {problem}"


def test_blanks_behind_a_delimiter_belong_neither_to_a_name_nor_to_a_value(tmp_path: Path) -> None:
    log = opened(tmp_path, 't, v, w\n0, 1, 0\n1, "2", 0\n')
    assert speeds(log) == [(1.0, 0.0), (2.0, 0.0)]
    assert not log.refused


def test_two_columns_of_one_name_are_refused_where_the_manifest_names_them(tmp_path: Path) -> None:
    with pytest.raises(LogFolderError, match=r"wheels\.csv: has 2 columns `v`; name its columns by `names`"):
        list(opened(tmp_path, "t,v,w,v\n0,1,0,2\n").readings())
    assert speeds(opened(tmp_path, "t,v,w,x,x\n0,1,0,2,3\n")) == [(1.0, 0.0)]


def test_a_value_that_is_missing_or_no_number_is_named_with_its_column(tmp_path: Path) -> None:
    log = opened(tmp_path, "t,v,w\n0,1,0\n2025-06-15T15:06:40.013Z,1,0\n2,,0\n3,1\n")
    assert speeds(log) == [(1.0, 0.0)]
    assert log.refused == {"wrong_type": 3}
    assert log.first_refused["wrong_type"].endswith("line 3: t: '2025-06-15T15:06:40.013Z' is not a number")


def test_the_first_bad_row_of_each_reason_is_named_with_its_line(tmp_path: Path) -> None:
    text = "# a comment\n0 1 0.5\n1 x 0.5\n2 y 0.5\n\n3 500 0\n2 1 0\n1 1 0\n"
    log = opened(tmp_path, text, 'names = ["t", "v", "w"]\ndelimiter = " "')
    assert len(speeds(log)) == 2
    assert log.refused == {"wrong_type": 2, "out_of_range": 1, "stamp_goes_back": 1}
    assert log.first_refused == {
        "wrong_type": "wheels.csv line 3: v: 'x' is not a number",
        "out_of_range": "wheels.csv line 6: wheels.speed_x_mps: 500.0 is not between -100 and 100",
        "stamp_goes_back": "wheels.csv line 8: it is older than the row before it",
    }


def test_a_file_without_any_row_that_can_be_used_ends_with_the_problem_of_its_first(tmp_path: Path) -> None:
    """As it is with stamps in another unit than the manifest has."""
    text = "t,v,w\n" + "".join(f"{T0 + i},1,0\n" for i in range(9))
    with pytest.raises(LogFolderError, match=r"wheels\.csv: none of its rows can be used; line 2: .*no.*UTC stamp"):
        list(opened(tmp_path, text).readings())
    assert list(opened(tmp_path, "t,v,w\n").readings()) == []
