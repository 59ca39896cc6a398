"""A log's truth: metres or degrees, another point, gaps, and errors."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import ConfigError, LogFolderError
from protocol.machine.log_folder import open_log
from protocol.site.site_config import Projection
from sitegrid.logs.log_truth import LogTruth, read_log_truth
from sitegrid.logs.replay import Trace, score
from tests.unit.sitegrid.logs.data import MANIFEST

START_NS = 1_700_000_000_000_000_000
METRES = 'stamp = "t"\nx_m = "x"\ny_m = "y"'


def truth_of(folder: Path, rows: str, described: str = METRES) -> LogTruth | None:
    (folder / "log.toml").write_text(MANIFEST)
    (folder / "truth.csv").write_text(rows)
    (folder / "evaluation.toml").write_text(f'[truth]\nfile = "truth.csv"\n{described}\n')
    return read_log_truth(open_log(folder), folder)


def at(truth: LogTruth | None, *times_s: float) -> list[list[float]]:
    assert truth
    return truth.track.at(np.array([START_NS + round(t * 1e9) for t in times_s])).tolist()


def test_degrees_and_metres_are_the_same_track(tmp_path: Path) -> None:
    places = [(3.0 * i, 100.0 - i) for i in range(5)]
    projection = Projection(open_log_of(tmp_path).site)
    degrees = [projection.to_geodetic(x, y)[:2] for x, y in places]
    metres = truth_of(tmp_path, "t,x,y\n" + "".join(f"{i},{x},{y}\n" for i, (x, y) in enumerate(places)))
    text = "t,lat,lon\n" + "".join(
        f"{i * 1000},{lat!r},{math.radians(lon)!r}\n" for i, (lat, lon) in enumerate(degrees)
    )
    named = 'stamp = { column = "t", unit = "ms" }\nlon_deg = { column = "lon", unit = "rad" }\nlat_deg = "lat"'
    geodetic = truth_of(tmp_path, text, named)
    assert at(geodetic, 0.0, 0.5, 4.0) == pytest.approx(np.array(at(metres, 0.0, 0.5, 4.0)), abs=1e-5)


def open_log_of(folder: Path):
    (folder / "log.toml").write_text(MANIFEST)
    return open_log(folder)


def test_between_rows_that_are_far_apart_nothing_is_known(tmp_path: Path) -> None:
    truth = truth_of(tmp_path, "t,x,y\n0,0,0\n1,1,0\n5,5,0\n6,6,0\n7,nan,0\n8,8,0\n9,9,0\n")
    known = [math.isfinite(x) for x, _ in at(truth, -0.1, 0.5, 1.0, 1.1, 3.0, 4.9, 5.0, 5.5, 6.5, 7.5, 8.5, 9.1)]
    assert known == [False, True, True, False, False, False, True, True, False, False, True, False]


def test_rows_that_do_not_count_are_no_truth(tmp_path: Path) -> None:
    """A reference states its quality in a column."""
    rows = "t,x,y,fix\n0,0,0,4\n1,900,900,1\n2,2,0,4\n"
    truth = truth_of(tmp_path, rows, METRES + "\nat_least = { fix = 4 }")
    assert at(truth, 1.0) == [[1.0, 0.0]]


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, 2.5])
def test_the_track_of_an_antenna_is_compared_with_where_the_machine_believes_it(heading: float, tmp_path: Path) -> None:
    """Ahead and left of base_link: a right pose has no error at any heading."""
    lever = np.array([2.0, 0.5])
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    base = np.array([[0.1 * i, -0.2 * i] for i in range(50)])
    rows = "".join(f"{i / 10},{x!r},{y!r}\n" for i, (x, y) in enumerate((base + turn @ lever).tolist()))
    truth = truth_of(tmp_path, "t,x,y\n" + rows, METRES + "\nmount = { xyz_m = [2.0, 0.5, 1.9] }")
    assert truth
    stamps = START_NS + np.arange(50) * 100_000_000
    covariances = np.broadcast_to(np.eye(2), (50, 2, 2))
    trace = Trace(stamps, base, covariances, np.full(50, heading), START_NS, int(stamps[-1]), 0.0)
    assert score(trace.moved(truth.lever_m), truth.track).net_m < 1e-9
    assert score(trace, truth.track).net_m == pytest.approx(math.hypot(2.0, 0.5))
    turned = replace(trace, heading_rad=trace.heading_rad + 0.1)
    assert score(turned.moved(truth.lever_m), truth.track).net_m == pytest.approx(0.1 * math.hypot(2.0, 0.5), rel=0.01)


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ("t,x,y\n0,0,0\n1,1,0\n0.5,2,0\n", "truth.csv: line 4: it is older than the row before it"),
        ("t,x,y\n0,0,0\n1,east,0\n", "truth.csv: line 3: x: 'east' is not a number"),
        ("t,x,y\nnan,0,0\n", "truth.csv: line 2: t: 'nan' is no time"),
        ("t,x,y\n0,4e5,0\n", "truth.csv: line 2: x_m: 400000.0 is beyond 100000"),
        ("t,x,y\n5,0,0\n5,1,0\n5,2,0\n", "truth.csv: the stamps of its 3 rows do not advance"),
    ],
)
def test_a_truth_that_cannot_be_is_refused_with_its_line(tmp_path: Path, rows: str, problem: str) -> None:
    with pytest.raises(LogFolderError) as caught:
        truth_of(tmp_path, rows)
    assert f"{tmp_path}/{problem}" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('file = "truth.csv"', "", "key `file` is missing"),
        ("[truth]", "[truht]", "unknown key `truht`; known: truth"),
        ('y_m = "y"', "", "its columns are stamp, x_m, y_m, or stamp, lat_deg, lon_deg; not stamp, x_m"),
        ('x_m = "x"', 'x_m = { column = "x", unit = "deg" }', "[truth] x_m: unit `deg` does not fit"),
        ('stamp = "t"', "stamp = { value = 3.0 }", "[truth] stamp: a column is expected"),
    ],
)
def test_a_wrong_side_file_is_refused_in_one_line(tmp_path: Path, old: str, new: str, problem: str) -> None:
    truth_of(tmp_path, "t,x,y\n0,0,0\n")
    side = tmp_path / "evaluation.toml"
    assert old in side.read_text()
    side.write_text(side.read_text().replace(old, new, 1))
    with pytest.raises((ConfigError, LogFolderError)) as caught:
        read_log_truth(open_log(tmp_path), tmp_path)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)
