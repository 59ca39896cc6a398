"""Recordings of one machine: the route and the sensors that were planned, whole or not there."""

from dataclasses import replace
from pathlib import Path

import pytest

from lab.campaign import recordings
from lab.campaign.recordings import PAPER, SETUPS, PlannedDrive
from lab.ground.experiment import LOADING

DRIVE = PlannedDrive(3, 0.5, setup=replace(PAPER, world="fast"))


@pytest.mark.parametrize(
    ("setup", "tours"),
    [(PAPER, ["west", "east", "middle", "west", "east"]), (LOADING, ["west", "east", "middle", "yard", "west"])],
)
def test_routes_take_turns_with_the_seeds(setup, tours):
    assert [PlannedDrive(seed, 1.0, setup=setup).tour for seed in range(5)] == tours


def test_a_machine_has_the_sensors_and_the_route_of_its_setup():
    drive = PlannedDrive(3, 1.0, "dgps", LOADING)
    sensors = {sensor.name for sensor in drive.machine.sensors}
    assert {"gps-1", "gps-2", "imu-3", "torque"} <= sensors
    assert "gps-3" not in sensors
    assert 'base = "loading"' in drive.scenario_toml
    assert 'routes = ["yard"]' in drive.scenario_toml


@pytest.mark.parametrize("name", SETUPS)
def test_drives_of_the_table_have_the_habits_and_the_shared_errors_of_their_scenario(name: str):
    setup = SETUPS[name]
    drive = PlannedDrive(3, 1.0, setup.preset, setup)
    gps = drive.scenario.preset(drive.preset).gps
    people = name.endswith("_driven")
    assert (drive.scenario.driving.wander_m > 0) == (drive.scenario.driving.stop_every_m is not None) == people
    assert (gps.machine_share, gps.site_share) == ((0.8, 0.5) if people else (0.0, 0.0))
    assert len([s for s in drive.machine.sensors if s.kind in ("gps", "imu", "attitude")]) == 9


@pytest.mark.slow
def test_a_recording_that_was_cut_off_is_made_anew(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    write = recordings.record

    def cut(*arguments: object) -> None:
        write(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(recordings, "record", cut)
    with pytest.raises(KeyboardInterrupt):
        recordings.make(DRIVE, tmp_path)
    assert not DRIVE.folder(tmp_path).exists()
    monkeypatch.setattr(recordings, "record", write)
    recorded = recordings.load(recordings.make(DRIVE, tmp_path))
    assert recorded.machine == DRIVE.machine
    assert {r.sensor for r in recorded.readings} <= {s.name for s in DRIVE.machine.sensors}
    assert [p.name for p in tmp_path.iterdir()] == [DRIVE.folder(tmp_path).name]
    monkeypatch.setattr(recordings, "record", lambda *_: pytest.fail("recorded again"))
    recordings.make(DRIVE, tmp_path)


def test_the_version_of_code_changes_with_each_source_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recordings, "ROOT", tmp_path)
    (tmp_path / "package").mkdir()
    seen = set()
    for i, name in enumerate(("a.py", "a.py", "package/b.toml", "package/c.urdf")):
        (tmp_path / name).write_text(f"x = {i}")
        seen.add(recordings.code_version.__wrapped__("a.py", "package"))
    (tmp_path / "package" / "notes.md").write_text("not a source")
    assert len(seen | {recordings.code_version.__wrapped__("a.py", "package")}) == 4


def test_what_is_only_said_in_another_way_is_the_same_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recordings, "ROOT", tmp_path)
    sources = (
        'def f(x):\n    return {"a": x}\n',
        '"""A module."""\n\ndef f(x):  # of x\n    """A function."""\n    return {\n        "a": x,\n    }\n',
        'def f(x):\n    return {"b": x}\n',
        'def f(x):\n    "a"\n',
    )
    seen = []
    for source in sources:
        (tmp_path / "a.py").write_text(source)
        seen.append(recordings.code_version.__wrapped__("a.py"))
    assert seen[0] == seen[1]
    assert len(set(seen)) == 3


def test_a_source_that_is_not_there_is_an_error():
    with pytest.raises(FileNotFoundError, match="nowhere"):
        recordings.code_version("protocol/units.py", "nowhere.py")


def test_a_digest_tells_where_one_text_ends():
    assert recordings.digest("ab", "c") != recordings.digest("a", "bc")
    assert len(recordings.digest("a")) == 10
