"""Recordings of one machine: planned route and sensors, complete or missing."""

from dataclasses import replace
from pathlib import Path

import pytest

from lab.campaign import recordings
from lab.campaign.recordings import PAPER, PlannedDrive
from lab.ground.experiment import LOADING

DRIVE = PlannedDrive(3, 0.5, setup=replace(PAPER, world="fast"))


@pytest.mark.parametrize(
    ("setup", "tours"),
    [(PAPER, ["west", "east", "middle", "west", "east"]), (LOADING, ["west", "east", "middle", "yard", "west"])],
)
def test_routes_take_turns_with_the_seeds(setup, tours):
    assert [PlannedDrive(seed, 1.0, setup=setup).tour for seed in range(5)] == tours


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
