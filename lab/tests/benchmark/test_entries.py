"""Files of entries: parsing, and refusal of wrong lines."""

import math
from pathlib import Path

import numpy as np
import pytest

from lab.benchmark.entries import is_samples, read_map, read_samples
from lab.benchmark.recordings import write_samples
from protocol.errors import ConfigError
from protocol.machine.samples import COLUMNS, empty
from sim.truth import TruthMap

GROUND = np.zeros((2, 3), np.float32)
TRUTH = TruthMap(10.0, 20.0, GROUND, GROUND, GROUND)
HEADER = "x_m,y_m,resistance,grade_east,grade_north"


def written(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "site-1.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_map_has_its_values_where_they_were_put_and_nothing_elsewhere(tmp_path: Path):
    path = written(
        tmp_path, f"{HEADER},confidence", "10.2,20.9,0.04,0.1,-0.1,0.8", "12.5,21.5,,,,", "11.5,20.5,nan,0,0,1"
    )
    layers = read_map(path, TRUTH)
    assert layers["resistance"][0, 0] == 0.04
    assert (layers["grade_east"][0, 0], layers["grade_north"][0, 0], layers["confidence"][0, 0]) == (0.1, -0.1, 0.8)
    assert np.isnan(layers["resistance"]).sum() == 5
    assert layers["grade_east"][0, 1] == 0.0
    assert not is_samples(path)
    assert "confidence" not in read_map(written(tmp_path, HEADER, "10.5,20.5,0.04,0,0"), TRUTH)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("13.0,20.5,0.04,0,0", "none of its places is on the site"),
        ("nan,20.5,0.04,0,0", "line 2: has no place"),
        ("10.5,20.5,soft,0,0", "line 2: resistance is 'soft', which is no number"),
        ("10.5,20.5,1e30,0,0", "line 2: resistance 1e.30 is not between -100 and 100"),
        ("10.5,20.5,0,04,0,0", "line 2: is longer than the header"),
        ("10.5,20.5,0.04,0,0\n10.1,20.1,0.05,0,0", "line 3: the cell of .10.1, 20.1. was named before"),
        ("10.5,20.5,0.04", "line 2: is shorter than the header"),
    ],
)
def test_a_wrong_line_of_a_map_is_named(tmp_path: Path, line: str, problem: str):
    with pytest.raises(ConfigError, match=problem):
        read_map(written(tmp_path, HEADER, line), TRUTH)


def test_a_file_without_its_columns_or_none_at_all_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="has no column grade_east, grade_north"):
        read_map(written(tmp_path, "x_m,y_m,resistance", "10.5,20.5,0.04"), TRUTH)
    with pytest.raises(ConfigError, match="is empty; its first line names the columns"):
        read_map(written(tmp_path, ""), TRUTH)
    with pytest.raises(ConfigError, match="has a header, but no lines"):
        read_map(written(tmp_path, HEADER), TRUTH)
    with pytest.raises(ConfigError, match=r"has no column .*; commas stand between columns"):
        read_map(written(tmp_path, HEADER.replace(",", ";"), "10.5;20.5;0.04;0;0"), TRUTH)
    with pytest.raises(ConfigError, match="has the column resistance twice"):
        read_map(written(tmp_path, f"{HEADER},resistance", "10.5,20.5,0.04,0,0,0.04"), TRUTH)
    with pytest.raises(ConfigError, match="has no column y_m, grade_north"):
        is_samples(written(tmp_path, "x_m,resistance,grade_east", "10.5,0.04,0"))
    with pytest.raises(ConfigError, match="an entry has one for each recording"):
        is_samples(tmp_path / "none.csv")
    (tmp_path / "site-1.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_map(tmp_path / "site-1.csv", TRUTH)


def samples(n: int) -> np.ndarray:
    rows = empty(n)
    rows["stamp_ns"] = 1_772_433_000_123_456_789 + np.arange(n)
    rows["x_m"], rows["c_rr"], rows["c_rr_var"] = 1 / 3, np.float32(0.04), math.nan
    rows["distance_m"] = 0.5
    rows["c_rr"][0] = math.nan
    rows["c_rr_var"] = np.where(np.isnan(rows["c_rr"]), math.nan, 1e-6)
    return rows


def test_samples_come_back_bit_for_bit(tmp_path: Path):
    path = tmp_path / "samples.csv"
    made = {"a": samples(3), "b": samples(2)}
    write_samples(path, made)
    assert is_samples(path)
    back = read_samples(path, made)
    assert list(back) == ["a", "b"]
    for name, rows in made.items():
        for column in COLUMNS:
            np.testing.assert_array_equal(back[name][column], rows[column])


def test_a_wrong_sample_is_named(tmp_path: Path):
    path = tmp_path / "samples.csv"
    write_samples(path, {"a": samples(2)})
    text = path.read_text()
    for old, new, problem in (
        ("1772433000123456790", "1.5", "line 3: stamp_ns is '1.5', which is no whole number"),
        ("1772433000123456790", str(2**63), "line 3: stamp_ns 9223372036854775808 is not between"),
        ("1772433000123456790", "1772433000123456789", "machine a: stamp_ns 1772433000123456789 comes twice"),
        ("0.5,", "50,", "machine a: distance_m adds up to 100 m, along a line of 0 m"),
        ("a,", "b,", "line 2: machine 'b' is none of the recording: a"),
        ("0.3333333333333333", "1e9", "machine a: .*x_m"),
        ("a,", "", "shorter than the header"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(ConfigError, match=problem):
            read_samples(path, ["a"])
    path.write_text(text.splitlines()[0] + "\n")
    with pytest.raises(ConfigError, match="has a header, but no lines"):
        read_samples(path, ["a"])
