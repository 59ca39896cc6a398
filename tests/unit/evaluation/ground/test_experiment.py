"""The ground's table on short recordings: kept, resumed, through the command line; and its pictures."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.sampling import LAG_S
from evaluation.campaign import recordings, tasks
from evaluation.campaign.recordings import Setup
from evaluation.ground import experiment
from protocol.errors import SitegridError
from sitegrid import cli

FAST = Setup("paper_site", ("west", "east"), gps=(1, 2), imu=(3,), world="fast")
CALIBRATED, HARSH = experiment.Row("kalman", "calibrated"), experiment.Row("kalman", "harsh")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def plan(cache: Path) -> experiment.Plan:
    return experiment.Plan(seeds=(4,), seconds=40.0, cache=cache, processes=1, rows=(CALIBRATED, HARSH), setup=FAST)


def test_every_row_is_judged_on_its_presets_recording(plan: experiment.Plan):
    said: list[tuple[float, float, str]] = []
    report, outcomes = experiment.run(plan, lambda *words: said.append(words))
    assert [(row["estimator"], row["preset"]) for row in report["rows"]] == [
        ("kalman", "calibrated"),
        ("kalman", "harsh"),
    ]
    assert said[-1][0] == said[-1][1] == 160.0
    assert sorted(p.name.split("-")[0] for p in plan.cache.iterdir()) == ["dgps", "harsh"]
    for row in report["rows"]:
        assert row["samples"] > row["judged_samples"] > 20
        assert row["cells"] > 20
        assert row["right_class_ci95"] is None  # of a single seed
        assert len(row["c_rr_bias_by_seed"]) == 1
    assert report["judged_from_s"] == 16.0
    assert {goal["name"] for goal in report["goals"]} == {name for name, _, _ in experiment.GOALS}
    assert (outcomes[0].run.samples["stamp_ns"] > 0).all()


def test_an_interrupted_run_goes_on_where_it_was(plan: experiment.Plan, monkeypatch: pytest.MonkeyPatch):
    first, outcomes = experiment.run(plan)
    experiment.run_file(outcomes[1].task).unlink()
    done: list[str] = []
    work = experiment._estimate
    monkeypatch.setattr(experiment, "_estimate", lambda job: (done.append(job[0].row.name), work(job)))
    monkeypatch.setattr(tasks, "make", lambda *_: pytest.fail("recorded again"))
    again, _ = experiment.run(plan)
    assert done == [outcomes[1].task.row.name]
    for rows in (first["rows"], again["rows"]):
        for row in rows:
            row.pop("us_per_second")
    np.testing.assert_equal(again, first)  # NaN is itself


def test_other_code_or_rows_never_meet_old_samples(plan: experiment.Plan, monkeypatch: pytest.MonkeyPatch):
    task = plan.task(4, CALIBRATED)
    files = {experiment.run_file(task), experiment.run_file(replace(task, row=experiment.Row("rls", "calibrated")))}
    files |= {experiment.run_file(replace(task, row=experiment.Row("kalman", "nominal")))}
    monkeypatch.setattr(experiment, "code_version", lambda *_: "other")
    files |= {experiment.run_file(task)}
    monkeypatch.setattr(recordings, "code_version", lambda *_: "other")
    files |= {experiment.run_file(task)}
    assert len(files) == 5


def test_sources_that_change_during_a_run_end_it(plan: experiment.Plan):
    with pytest.raises(SitegridError, match="start it again"):
        experiment._estimate((plan.task(4, CALIBRATED), Path("named-by-other-code.npz")))


def test_rows_configure_the_estimator_and_its_calibration():
    found = {row.name: row.options.estimation for row in experiment.ROWS}
    assert len(found) == 6
    assert {(e.estimator, e.calibrate) for e in found.values()} == {
        (name, calibrate) for name in ("kalman", "rls") for calibrate in (True, False)
    }
    assert not found["kalman-nominal"].calibrate


def test_goals_say_what_is_met():
    row = dict.fromkeys((name for name, _, _ in experiment.GOALS), 0.0)
    row |= {"right_class_pct": 96.0, "grade_bias_deg": -0.2, "grade_std_deg": math.nan}
    met = {g["name"]: g["met"] for g in experiment.goals({"estimator": "kalman", "preset": "calibrated", **row})}
    assert met["right_class_pct"]
    assert met["wrong_cells_pct"]
    assert not met["grade_bias_deg"]  # by its size
    assert not met["grade_std_deg"]
    assert not met["dirt_flat_right_pct"]


@pytest.mark.parametrize(("seconds", "settled"), [(600.0, 240.0), (1200.0, 240.0), (100.0, 40.0)])
def test_a_machine_has_time_to_settle(seconds, settled):
    assert experiment.settle_s(seconds) == settled


def test_loaders_take_the_routes_of_the_work_in_turn():
    drives = [recordings.Drive(seed, 1.0, "dgps", experiment.LOADING) for seed in range(5)]
    assert [drive.tour for drive in drives] == ["west", "east", "middle", "yard", "west"]
    sensors = {sensor.name for sensor in drives[0].machine.sensors}
    assert {"gps-1", "gps-2", "imu-3", "torque"} <= sensors
    assert "gps-3" not in sensors
    assert 'base = "loading"' in drives[3].scenario_toml
    assert 'routes = ["yard"]' in drives[3].scenario_toml


def test_the_command_prints_one_object_and_draws(
    plan: experiment.Plan, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("matplotlib", reason="needs the extra `eval`")
    plans = []
    run = experiment.run
    monkeypatch.setattr(experiment, "run", lambda asked, show: (plans.append(asked), run(plan, show))[1])
    words = ["eval", "ground", "--seeds", "1", "--first-seed", "4", "--seconds", "40", "--out", str(plan.cache)]
    assert cli.main([*words, "--processes", "1", "--json", "--plots", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {"rows", "goals", "plots"} <= set(found)
    assert [Path(p).name for p in found["plots"]] == ["along_seed4.png", "places_seed4.png", "summary.png"]
    for path in found["plots"]:
        picture = cv2.imread(path)
        assert picture.shape[1] > 800
        assert picture.std() > 10
    assert (plans[0].seeds, plans[0].seconds, plans[0].processes) == ((4,), 40.0, 1)
    assert plans[0].setup == experiment.LOADING
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert "kalman calibrated" in shown
    assert "right_class_pct" in shown
    assert (len(plans[1].rows), plans[1].processes > 0) == (6, True)


def test_a_tour_without_samples_still_has_rows_and_pictures(plan: experiment.Plan, tmp_path: Path):
    ground_plots = pytest.importorskip("evaluation.ground.plots", reason="needs the extra `eval`")
    _, outcomes = experiment.run(plan)
    nothing = replace(outcomes[0].run, samples=outcomes[0].run.samples[:0])
    way, here = outcomes[0].way, outcomes[0].ground
    judged = experiment.judge(nothing.samples, way, here, LAG_S, outcomes[0].from_ns)
    silent = replace(outcomes[0], run=nothing, judged=judged)
    row = experiment.summarise(CALIBRATED, [silent, silent])
    assert row["cells"] == 0
    assert math.isnan(row["right_class_pct"])
    assert [p.name for p in ground_plots.draw([silent], tmp_path)] == ["summary.png"]
    assert ground_plots.draw([], tmp_path) == []
