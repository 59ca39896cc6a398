"""The table on short recordings: cached, resumed, the same for all rows; and its pictures."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evaluation.campaign import recordings, tasks
from evaluation.campaign.workers import each
from evaluation.positions import table
from evaluation.positions.configurations import Configuration, UnsupportedError
from protocol.errors import ConfigError, SitegridError
from protocol.machine.machine_config import MachineConfig

ONE, TWO = (Configuration("ukf", gps, 1, "default") for gps in (1, 2))
NEVER = Configuration("ukf", 9, 1, "default")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def plan(cache: Path) -> table.Plan:
    return table.Plan(seeds=(3,), seconds=20.0, rows=(ONE, TWO, NEVER), cache=cache, processes=1)


def test_rows_are_scored_on_one_recording_and_what_cannot_run_is_named(plan: table.Plan):
    said: list[tuple[float, float, str]] = []
    report, outcomes = table.run(plan, lambda *words: said.append(words))
    assert [(row["gps"], row["paper_net_m"]) for row in report["rows"]] == [(1, 2.3234), (2, 1.7217)]
    assert all(0.05 < row["net_m"] < 8 and 0.3 < row["covered"] < 1 for row in report["rows"])
    assert all(row["us_per_second"] > 100 for row in report["rows"])
    assert [m["gps"] for m in report["missing"]] == [9]
    assert report["gps_error"]["slow_variance_share"] == 0.9
    assert report["gps_error"]["correlation_time_s"] == 45.0
    assert said[-1][0] == said[-1][1] == 60.0
    assert "seed 3" in said[0][2]
    assert len(list(plan.cache.iterdir())) == 1
    assert len(outcomes[0].curves.time_s) > 8


def test_poses_are_found_without_the_ground(plan: table.Plan, monkeypatch: pytest.MonkeyPatch):
    """What it costs is what localisation costs."""
    monkeypatch.setattr("agents.pipeline.GroundEstimator", lambda *_: pytest.fail("estimates the ground"))
    monkeypatch.setattr(table, "code_version", lambda *_: "never run before")
    report, _ = table.run(replace(plan, rows=(ONE,)))
    assert report["rows"][0]["covered"] > 0.3


def test_an_interrupted_run_goes_on_where_it_was(plan: table.Plan, monkeypatch: pytest.MonkeyPatch):
    first, outcomes = table.run(plan)
    table.result_file(outcomes[1].task).unlink()
    done: list[str] = []
    work = table._replay
    monkeypatch.setattr(table, "_replay", lambda job: (done.append(job[0].row.name), work(job)))
    monkeypatch.setattr(tasks, "make", lambda *_: pytest.fail("recorded again"))
    again, _ = table.run(plan)
    assert done == [TWO.name]
    timeless = [[{k: v for k, v in row.items() if k != "us_per_second"} for row in r["rows"]] for r in (first, again)]
    assert timeless[0] == timeless[1]  # the same code on the same recording: the same figures
    table.run(plan)
    assert done == [TWO.name]


def test_other_code_or_options_never_meet_old_results(plan: table.Plan, monkeypatch: pytest.MonkeyPatch):
    task = table.Task(plan.drives[0], ONE, plan.cache)
    files = {table.result_file(task), table.result_file(replace(task, row=TWO))}
    files |= {table.result_file(replace(task, drive=replace(task.drive, seconds=21.0)))}
    monkeypatch.setattr(table, "code_version", lambda *_: "other")
    files |= {table.result_file(task)}
    monkeypatch.setattr(recordings, "code_version", lambda *_: "other")
    files |= {table.result_file(task)}
    assert len(files) == 5


def test_a_recording_that_was_cut_off_is_made_anew(plan: table.Plan, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    drive = replace(plan.drives[0], seconds=0.5)
    write = recordings.record

    def cut(*arguments: object) -> None:
        write(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(recordings, "record", cut)
    with pytest.raises(KeyboardInterrupt):
        recordings.make(drive, tmp_path)
    assert not drive.folder(tmp_path).exists()
    monkeypatch.setattr(recordings, "record", write)
    found = recordings.load(recordings.make(drive, tmp_path))
    assert found.machine == drive.machine
    assert {r.sensor for r in found.readings} <= {s.name for s in drive.machine.sensors}
    assert [p.name for p in tmp_path.iterdir()] == [drive.folder(tmp_path).name]


def test_tours_take_turns_with_the_seeds():
    assert [recordings.Drive(seed, 1.0).tour for seed in range(4)] == ["west", "east", "middle", "west"]


def test_code_version_changes_with_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.py").write_text("x = 1")
    monkeypatch.setattr(recordings, "ROOT", tmp_path)
    before = recordings.code_version.__wrapped__("a.py")
    (tmp_path / "a.py").write_text("x = 2")
    assert recordings.code_version.__wrapped__("a.py") != before


def test_jobs_run_in_processes_of_one_thread_and_leave_no_trace(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = dict(each(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"], processes=2))
    assert found == {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    assert "OMP_NUM_THREADS" not in os.environ


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_in_a_job_ends_the_run(processes: int):
    with pytest.raises(ValueError, match="invalid literal"):
        list(each(int, ["1", "x", "2"], processes))


def _refuse(place: str) -> None:
    raise ConfigError(place, "is wrong")


@pytest.mark.parametrize("processes", [1, 2])
def test_an_error_of_ours_comes_back_with_its_message(processes: int):
    with pytest.raises(SitegridError, match=r"^a.toml: is wrong$"):
        list(each(_refuse, ["a.toml", "a.toml"], processes))


def test_sources_that_change_during_a_run_end_it(plan: table.Plan):
    task = table.Task(plan.drives[0], ONE, plan.cache)
    with pytest.raises(SitegridError, match="start it again"):
        table._replay((task, Path("named-by-other-code.json")))


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at /proc")
def test_workers_end_with_a_parent_that_is_killed():
    code = "import time; from evaluation.campaign.workers import each\nlist(each(time.sleep, [90, 90], 2))"
    parent = subprocess.Popen([sys.executable, "-c", code])
    listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    workers = wait_for(lambda: found if len(found := listed.read_text().split()) >= 3 else None)
    wait_for(lambda: all(len(list(Path(f"/proc/{w}/task").iterdir())) > 1 for w in workers[1:]))  # they watch
    parent.kill()
    parent.wait()
    assert wait_for(lambda: not any(is_alive(worker) for worker in workers))


def is_alive(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for(found: Callable[[], Any]) -> Any:
    """What `found` returns once it is true."""
    deadline = time.monotonic() + 30
    pause = threading.Event()
    while not (value := found()):
        assert time.monotonic() < deadline, "nothing happened for 30 s"
        pause.wait(0.05)
    return value


def test_pictures_are_drawn(plan: table.Plan, tmp_path: Path):
    cv2 = pytest.importorskip("cv2")
    plots = pytest.importorskip("evaluation.positions.plots", reason="needs the extra `eval`")
    paths = plots.draw(*table.run(plan), tmp_path)
    assert [p.name for p in paths] == ["table.png", "errors.png", "tracks_seed3.png"]
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture.shape[1] > 800
        assert picture.std() > 10
    assert plots.draw({}, [], tmp_path) == []


def test_a_configuration_that_never_had_a_pose_still_has_a_row(
    plan: table.Plan, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """20 s in which GPS is not heard: the machine cannot know where it is."""
    assert plan.cache.exists()
    monkeypatch.setattr(table, "configure", _deaf)
    report, outcomes = table.run(replace(plan, rows=(ONE,)))
    row = report["rows"][0]
    assert row["covered"] == 0.0
    assert row["net_m"] != row["net_m"]  # NaN; the command prints null
    assert pytest.importorskip("evaluation.positions.plots").draw(report, outcomes, tmp_path) == []


def _deaf(machine: MachineConfig, row: Configuration) -> object:
    from agents.pipeline import PipelineConfig

    if row.gps > 3:
        raise UnsupportedError("no")
    return replace(machine, sensors=tuple(replace(s, use=s.kind != "gps") for s in machine.sensors)), PipelineConfig()
