"""The pages agree with the code: names, limits, a working example."""

import itertools
import re
from collections.abc import Iterable
from dataclasses import fields

import pytest

from agents.holdout import FIGURES
from protocol.errors import Refusal
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MODES, QUANTITIES
from protocol.machine.readings import KINDS, MAX_STAMP_NS, columns
from protocol.machine.samples import COLUMNS
from protocol.queries import calibration as cal
from protocol.queries import commands, parameters, requests
from protocol.queries.answers import GroundChange, MachineState, MapInfo, SampleCounts
from protocol.queries.request import parameters_of
from protocol.site.geometry import MAX_CELLS
from protocol.units import _NS, _UNITS
from protocol.wire import codec
from protocol.wire.fields import MAX_SMALL_BYTES
from protocol.wire.messages import Pose
from sitegrid.logs.ground import FIGURES as GROUND
from sitegrid.logs.log_truth import read_known_ground, read_log_truth
from sitegrid.logs.run import TRUTH_FIGURES
from tests.paths import DOCS

CALIBRATION = (cal.CalibrationAnswer, cal.MachineCalibration, cal.CorrectedSpan)
WIRE, LOGS = ((DOCS / name).read_text() for name in ("protocol.md", "log-folders.md"))


def undocumented(names: Iterable[str], page: str) -> list[str]:
    return [name for name in names if f"`{name}`" not in page]


def test_every_name_of_the_wire_is_documented():
    records = (
        field.name
        for record in (Pose, MapInfo, SampleCounts, MachineState, GroundChange, *CALIBRATION)
        for field in fields(record)
    )
    assert undocumented([*COLUMNS, *KINDS, *records, *Refusal], WIRE) == []


def test_every_column_of_a_reading_is_documented():
    wide = WIRE.replace("`gyro_{x,y,z}_radps`", "`gyro_x_radps` `gyro_y_radps` `gyro_z_radps`")
    wide = wide.replace("`force_{x,y,z}_mps2`", "`force_x_mps2` `force_y_mps2` `force_z_mps2`")
    assert undocumented((name for kind in KINDS for name in columns(kind)), wide) == []


def test_the_table_of_calibration_has_the_fields_of_the_answer_and_of_a_machine():
    section = WIRE[WIRE.index("\n### Calibration of machines\n") + 1 :].partition("\n### ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    names = re.findall(r"`(.*?)`", "".join(rows))
    both = [field.name for record in CALIBRATION[:2] for field in fields(record)]
    assert names == [name for name in both if name not in ("store", "merged", "fact")]


def test_limits_are_the_documented_ones():
    assert (codec.MAX_BATCH_BYTES, codec.MAX_BUNDLE_BYTES, MAX_SMALL_BYTES) == (4 * 2**20, 2**20, 64 * 2**10)
    assert "at most 4 MiB" in WIRE
    assert "At most 1 MiB" in WIRE
    for number in (codec.MAX_BATCH_SAMPLES, MAX_STAMP_NS, f"{MAX_CELLS:,}", "2^62", "2^64 - 1"):
        assert str(number) in WIRE
    assert codec.MAX_SEQ == 2**62


def test_every_parameter_of_a_query_is_documented():
    for query, cls in requests.QUERIES.items():
        names = parameters_of(cls)
        [row] = re.findall(rf"\n\| `{query}` \| (.*) \|", WIRE[: WIRE.index("Answers:")])
        documented = {name.split("=")[0] for name in re.findall(r"`(.*?)`", row)}
        assert documented - {"after"} == set(names) - {"after", "wait"}, query


def test_every_parameter_and_limit_of_a_command_is_documented():
    for command, names in ((name, parameters_of(cls)) for name, cls in commands.COMMANDS.items()):
        [row] = re.findall(rf"\n\| `{command}` \| (.*?) \|", WIRE)
        assert re.findall(r"`(.*?)`", row) == [*names]
    assert f"at most {parameters.MAX_TEXT} characters" in WIRE
    assert f"More than {requests.MAX_SPANS} spans" in WIRE
    assert parameters.MAX_WAIT_S == 60


EXAMPLES = re.findall(r"`sitegrid/paper/(map|admin)/(\w+)\?(.*?)`", WIRE)


@pytest.mark.parametrize(("root", "name", "selector"), EXAMPLES)
def test_example_of_a_query_is_read_and_written(root, name, selector):
    given = parameters.split_selector(selector)
    if root == "admin":
        parsed = commands.parse_command(name, given)
        assert parsed.reason == "antenna moved; x = 3 m"
        assert commands.parse_command(name, parsed.parameters()) == parsed
    else:
        parsed = requests.parse_query(name, given)
        assert requests.parse_query(name, parsed.parameters()) == parsed


@pytest.mark.parametrize(
    ("title", "record"), [("Info", MapInfo), ("Machines", MachineState), ("Changes", GroundChange)]
)
def test_fields_of_an_answer_are_the_documented_ones(title, record):
    table = WIRE[WIRE.index(f"### {title}\n") :].partition("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert re.findall(r"`(.*?)`", "".join(rows)) == [field.name for field in fields(record)]


def test_every_part_of_a_sensor_is_documented():
    table = LOGS[LOGS.index("## What a sensor measures") : LOGS.index("## Modes")]
    for kind, parts in QUANTITIES.items():
        rows = table[table.index(f"| `{kind}` |") :].splitlines()
        own = [rows[0], *itertools.takewhile(lambda row: row.startswith("| |"), rows[1:])]
        assert [row.split("|")[2].split("`")[1] for row in own] == [*parts], kind


def test_every_mode_and_unit_of_a_log_is_documented():
    assert undocumented([*MODES, *_UNITS, *_NS], LOGS) == []


def test_example_of_a_manifest_is_read(tmp_path):
    (tmp_path / "log.toml").write_text(re.search(r"```toml\n(.*?)```", LOGS, re.DOTALL)[1])
    (tmp_path / "gps.csv").write_text("")
    log = open_log(tmp_path)
    assert [source.file.file for source in log.sources] == [
        *("gps.csv.gz", "tracker.txt", "gps.csv.gz", "can.csv", "wheels.csv")
    ]
    assert [s.use for s in log.machine.sensors] == [True] * 4 + [False]


def test_example_of_a_log_of_ones_own_is_read(tmp_path):
    page = LOGS[LOGS.index("\n## A log of your own\n") :]
    manifest, truth = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "log.toml").write_text(manifest)
    (tmp_path / "evaluation.toml").write_text(truth)
    (tmp_path / "groundtruth.csv").write_text("1326030975000000,1,2,3,0,0,0\n")
    log = open_log(tmp_path)
    assert [source.file.file for source in log.sources] == ["gps.csv", "imu.csv", "wheels.csv"]
    read = read_log_truth(log, tmp_path)
    assert read.track.position_m.tolist() == [[2.0, 1.0]]


def test_examples_of_known_ground_are_read(tmp_path):
    (tmp_path / "log.toml").write_text(re.search(r"```toml\n(.*?)```", LOGS, re.DOTALL)[1])
    sides = [side for side in re.findall(r"```toml\n(.*?)```", LOGS, re.DOTALL) if "[[ground]]" in side]
    areas = []
    for side in sides:
        (tmp_path / "evaluation.toml").write_text(side)
        areas += read_known_ground(open_log(tmp_path), tmp_path)
    assert [(area.name, area.c_rr, area.has_gradient) for area in areas] == [
        ("ramp", 0.02, True),
        ("gravel", 0.02, False),
    ]


def test_every_figure_of_a_replay_is_documented():
    figures = [*FIGURES, *GROUND, *(f"truth_{name}" for name in TRUTH_FIGURES)]
    assert undocumented(figures, LOGS) == []
