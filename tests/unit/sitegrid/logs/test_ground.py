"""A log's ground against known areas."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from protocol.errors import ConfigError
from protocol.machine.log_folder import LogFolder, open_log
from protocol.machine.samples import empty
from protocol.site.site_config import KnownGround
from sitegrid.logs import ground
from sitegrid.logs.check import missing_for_ground
from sitegrid.logs.ground import compare, samples_of
from sitegrid.logs.log_truth import KnownArea, read_known_ground
from tests.unit.sitegrid.logs.data import MANIFEST, write_circle

PAD = KnownArea("pad", ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)), c_rr=0.02, grade_east=0.1)


def samples(*places: tuple[float, float]):
    rows = empty(len(places))
    rows["x_m"], rows["y_m"] = np.array(places).T
    rows["distance_m"], rows["cov_xx_m2"], rows["cov_yy_m2"] = 0.5, 0.25, 0.04
    rows["c_rr"], rows["c_rr_var"], rows["grade_e"], rows["grade_n"], rows["grade_var"] = 0.03, 1e-4, 0.1, 0.0, 1e-6
    return rows


def test_samples_that_are_surely_inside_are_compared_with_what_is_known_of_an_area() -> None:
    """The third is inside by less than its standard deviation, the fourth outside, the second another pass."""
    rows = samples((5, 5), (2, 8), (0.4, 5), (12, 5))
    rows["c_rr"][1], rows["distance_m"][1], rows["stamp_ns"][1] = 0.06, 1.0, 60 * 10**9
    resistance, gradient = compare(rows, [PAD])
    named = {"area": "pad", "figure": "c_rr", "known": 0.02}
    figures = {
        "mean": 0.05,
        "off": 0.03,
        "spread": 0.015,
        "mean_95": round(12.7062 * 0.015, 4),
        "rms": round(math.sqrt((0.01**2 + 0.04**2) / 2), 4),
        "std": 0.01,
    }
    assert resistance == {**named, **figures, "samples": 2, "passes": 2, "metres": 1.5}
    assert (gradient["figure"], gradient["mean"], gradient["off"], gradient["std"]) == ("grade_east", 0.1, 0.0, 0.001)


def log_of(folder: Path, side: str = "", known: str = "") -> LogFolder:
    write_circle(folder)
    (folder / "log.toml").write_text(MANIFEST.replace('name = "yard",', f'name = "yard", {known}'))
    (folder / "evaluation.toml").write_text(side)
    return open_log(folder)


def test_areas_come_from_the_side_file_and_from_the_site(tmp_path: Path) -> None:
    outline = "outline = [[0, 0], [9, 0], [9, 9]]"
    side = f'[[ground]]\nname = "ramp"\n{outline}\ngrade_north = 0.1\n'
    log = log_of(tmp_path, side, f'known_ground = [{{ name = "pad", c_rr = 0.01, {outline} }}],')
    ramp, pad = read_known_ground(log, tmp_path)
    assert (ramp.name, ramp.c_rr, ramp.grade_north, ramp.has_gradient) == ("ramp", None, 0.1, True)
    assert (pad.name, pad.c_rr, pad.has_gradient) == ("pad", 0.01, False)


@pytest.mark.parametrize(
    ("described", "problem"),
    [
        ('name = "ramp"\noutline = [[0, 0], [9, 0]]\nc_rr = 0.1', "2 corners are no area"),
        ('name = "ramp"\noutline = [[0, 0], [9, 0], [9, 9]]', "state c_rr, grade_east or grade_north"),
        ('name = "ramp"\noutline = [[0, 0], [9, 0], [9, 9]]\nc_rr = 3', "c_rr: 3.0 is not between 0 and 1"),
    ],
)
def test_an_area_that_cannot_be_is_refused_in_one_line(tmp_path: Path, described: str, problem: str) -> None:
    log = log_of(tmp_path, f"[[ground]]\n{described}\n")
    with pytest.raises(ConfigError) as caught:
        read_known_ground(log, tmp_path)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_machine_is_not_told_what_it_is_compared_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = log_of(tmp_path)
    area = KnownGround("pad", 0.01, ((0.0, 0.0), (200.0, 0.0), (200.0, 200.0)))
    informed = replace(log, site=replace(log.site, known_ground=(area,)))
    sites = []
    pipeline = ground.Pipeline
    monkeypatch.setattr(ground, "Pipeline", lambda site, *rest: sites.append(site) or pipeline(site, *rest))
    samples_of(informed, LocalisationConfig(filter="ekf"), [])
    assert sites == [log.site]


SENSOR = '[[sensor]]\nname = "{kind}"\nkind = "{kind}"\nfile = "x.csv"\ncolumns = {{ stamp = "t", {columns} }}\n'
IMU = SENSOR.format(
    kind="imu", columns=", ".join(f'{c} = "x"' for c in ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps")) + ", "
    + ", ".join(f'force_{axis}_mps2 = "x"' for axis in "xyz"),
)  # fmt: skip
TORQUE = SENSOR.format(kind="torque", columns='torque_nm = "x"')
RAMP = replace(PAD, c_rr=None)
LEVEL = replace(PAD, grade_east=None)


@pytest.mark.parametrize(
    ("sensors", "areas", "why"),
    [
        (TORQUE, [PAD], "no IMU with forces"),
        (IMU, [], "no ground is known; describe areas as [[ground]] in evaluation.toml"),
        (IMU, [LEVEL], "no torque sensor"),
        (IMU, [LEVEL, RAMP], ""),
    ],
)
def test_what_is_missing_for_ground_is_said(tmp_path: Path, sensors: str, areas: list[KnownArea], why: str) -> None:
    write_circle(tmp_path)
    (tmp_path / "log.toml").write_text(MANIFEST + sensors)
    said = missing_for_ground(open_log(tmp_path).machine, areas)
    assert said.startswith(why) if why else not said
