"""Runner of experiments: cached results, resumed runs, no mixing of code versions."""

import json
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from lab.campaign import experiment as module
from lab.campaign.experiment import Experiment, Runner, Task, read_result, replay_task, write_result
from lab.campaign.recordings import PlannedDrive
from protocol.errors import SitegridError

DONE = "done.txt"  # in the cache: names of finished tasks, one per line


@dataclass(frozen=True)
class Power:
    exponent: int

    @property
    def name(self) -> str:
        return f"power{self.exponent}"


@dataclass(frozen=True)
class Numbers:
    value: int
    powers: np.ndarray


def solve(task: Task[Power], cache: Path) -> Numbers:
    with (cache / DONE).open("a") as file:
        file.write(f"{task.name}\n")
    if task.variant.exponent < 0:
        raise ValueError("no")
    return Numbers(task.seed**task.variant.exponent, np.arange(3) ** task.variant.exponent)


POWERS = Experiment("powers", Numbers, solve)
TASKS = [Task(Power(exponent), seed, 5.0) for seed in (2, 3) for exponent in (1, 2)]


def done(cache: Path) -> list[str]:
    return (cache / DONE).read_text().split()


def test_results_come_task_by_task_and_are_kept(tmp_path: Path):
    said: list[tuple[float, float, str]] = []
    runner = Runner(tmp_path, on_progress=lambda *words: said.append(words))
    assert [numbers.value for numbers in runner.run(POWERS, TASKS)] == [2, 4, 3, 9]
    assert said[0] == (5.0, 20.0, "seed2-power1")
    assert said[-1][:2] == (20.0, 20.0)
    again = runner.run(POWERS, list(reversed(TASKS)))
    assert [numbers.value for numbers in again] == [9, 3, 4, 2]
    assert len(done(tmp_path)) == 4
    assert len(said) == 4


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path):
    runner = Runner(tmp_path)
    with pytest.raises(ValueError, match="no"):
        runner.run(POWERS, [*TASKS[:2], Task(Power(-1), 2, 5.0), *TASKS[2:]])
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    assert not list(tmp_path.rglob("*.part"))
    runner.run(POWERS, TASKS)
    assert done(tmp_path) == ["seed2-power1", "seed2-power2", "seed2-power-1", "seed3-power1", "seed3-power2"]


def test_every_input_of_a_result_names_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    drive = PlannedDrive(2, 5.0)
    tasks = [TASKS[0], TASKS[1], replace(TASKS[0], seed=4), replace(TASKS[0], seconds=6.0)]
    tasks += [replay_task(Power(1), drive), replay_task(Power(1), replace(drive, preset="dgps"))]
    files = {POWERS.file(task, tmp_path) for task in tasks}
    files |= {replace(POWERS, name="others").file(TASKS[0], tmp_path)}
    files |= {replace(POWERS, also=("mapserver.server",)).file(TASKS[0], tmp_path)}
    monkeypatch.setattr("lab.campaign.recordings.code_version", lambda *_: "another simulator")
    files |= {POWERS.file(tasks[-1], tmp_path)}
    monkeypatch.setattr(module, "code_version", lambda *_: "other code")
    files |= {POWERS.file(TASKS[0], tmp_path)}
    assert len(files) == len(tasks) + 4


def test_sources_that_change_during_a_run_end_it(tmp_path: Path):
    with pytest.raises(SitegridError, match="the sources changed during the run: start it again"):
        module._work((POWERS, TASKS[0], tmp_path, tmp_path / "named-by-other-code.npz"))
    assert not list(tmp_path.iterdir())


def test_each_recording_is_made_once_and_only_for_tasks_that_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made: list[PlannedDrive] = []
    monkeypatch.setattr(module, "make", lambda drive, cache: (made.append(drive), drive.folder(cache).mkdir()))
    said: list[tuple[float, float, str]] = []
    drives = [PlannedDrive(seed, 5.0) for seed in (2, 3)]
    tasks = [replay_task(Power(exponent), drive) for drive in drives for exponent in (1, 2)]
    runner = Runner(tmp_path, on_progress=lambda *words: said.append(words))
    runner.run(POWERS, tasks[:2])
    assert made == drives[:1]
    assert said[0] == (5.0, 15.0, "recorded seed 2 paper")
    runner.run(POWERS, tasks)
    assert made == drives
    assert said[-1][:2] == (25.0, 25.0)


def test_a_result_is_read_as_it_was_written(tmp_path: Path):
    @dataclass(frozen=True)
    class Result:
        rows: np.ndarray
        nothing: np.ndarray
        counts: dict[str, int]
        error: float
        median: float | None

    rows = np.array([(1, 2.5)], [("stamp_ns", "<i8"), ("x_m", "<f4")])
    file = BytesIO()
    write_result(Result(rows, np.empty((0, 2)), {"b": 1, "a": 2}, float("nan"), None), file)
    (tmp_path / "result.npz").write_bytes(file.getvalue())
    result = read_result(Result, tmp_path / "result.npz")
    assert (result.rows.tobytes(), result.rows.dtype, result.nothing.shape) == (rows.tobytes(), rows.dtype, (0, 2))
    assert json.dumps(result.counts) == '{"b": 1, "a": 2}'
    assert np.isnan(result.error)
    assert result.median is None
