"""[record]: bounded, never stopping a machine."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from agents.recorder import AGAIN_S, FILES, ReadingsRecorder, RecordConfig
from protocol.machine.recorded_readings import readings_of
from protocol.recording import Recording
from tests.unit.agents.drives import S_BEND, VEHICLE, drive, thinned

READINGS = thinned(drive(S_BEND, VEHICLE).readings)
BEGIN_NS = 10**18


class Recorder:
    """A recorder and its clock."""

    def __init__(self, folder: Path, max_mb: float) -> None:
        self.now_s = 0.0
        config = RecordConfig(str(folder), max_mb)
        clocks = (lambda: BEGIN_NS + round(self.now_s * 1e9), lambda: self.now_s)
        self.recorder = ReadingsRecorder(config, "paper", VEHICLE, *clocks)

    def drive(self, seconds: int) -> None:
        for _ in range(seconds):
            self.recorder.take(READINGS[:200])
            self.now_s += 10.0  # longer than a flush interval
            self.recorder.tend()


def test_the_oldest_files_make_room_and_others_stay(tmp_path: Path):
    max_mb = 0.2
    (tmp_path / f"{VEHICLE.name}-2.20260101T000000.000000Z.mcap").touch()  # another machine's
    (tmp_path / f"{VEHICLE.name}.20010101T000000.000000Z.mcap.part").write_bytes(bytes(1000))  # left by a kill
    recorder = Recorder(tmp_path, max_mb)
    recorder.drive(100)
    recorder.recorder.close()
    files = sorted(tmp_path.glob(f"{VEHICLE.name}.*"))
    assert len(files) > FILES / 2
    assert sum(path.stat().st_size for path in files) < max_mb * 1e6 * (1 + 1 / FILES)
    assert {path.suffix for path in files} == {".mcap"}, "the interrupted one was the oldest"
    assert len(list(tmp_path.iterdir())) == len(files) + 1
    assert recorder.recorder.report() == {"readings": 20_000, "missed": 0, "problem": ""}
    assert all(len(list(readings_of(path))) % 200 == 0 for path in files)


def test_a_full_disk_is_a_problem_that_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    recorder = Recorder(tmp_path, 100.0)
    recorder.drive(1)
    with monkeypatch.context() as full:

        def fail(*_: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device", "the file")

        full.setattr(Recording, "tend", fail)
        recorder.drive(2)
    report = recorder.recorder.report()
    assert report == {
        "readings": 400,
        "missed": 200,
        "problem": "readings are not recorded: the file: No space left on device",
    }
    recorder.now_s += AGAIN_S
    recorder.drive(1)
    recorder.recorder.close()
    assert recorder.recorder.report()["problem"] == ""
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".mcap", ".part"]
