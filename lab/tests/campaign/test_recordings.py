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
