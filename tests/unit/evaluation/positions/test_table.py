"""The table on short recordings, and its pictures."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from agents.pipeline import PipelineConfig
from evaluation.campaign.experiment import Runner
from evaluation.campaign.recordings import PAPER
from evaluation.positions import table
from evaluation.positions.configurations import Configuration
from protocol.machine.machine_config import MachineConfig

FAST = replace(PAPER, world="fast")
ONE, TWO = (Configuration("ukf", gps, 1, "default") for gps in (1, 2))
pytestmark = pytest.mark.slow  # a recording, and two filters that follow it
NEVER = Configuration("ukf", 9, 1, "default")
SECONDS = 14.0


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[table.TableReport, list[table.Outcome]]:
    return table.run(runner, (3,), SECONDS, (ONE, TWO, NEVER), FAST)


def test_rows_are_scored_on_one_recording_and_what_cannot_run_is_named(result, runner: Runner):
    report, outcomes = result
    assert [(row.gps, row.paper_net_m) for row in report.rows] == [(1, 2.3234), (2, 1.7217)]
    assert all(0.05 < row.net_m < 8 and 0.3 < row.covered < 1 for row in report.rows)
    assert all(row.us_per_second > 100 for row in report.rows)
    assert [row.gps for row in report.missing] == [9]
    assert "9" in report.missing[0].why
    assert len(list(runner.cache.glob("paper-seed3-*"))) == 1
    assert len(outcomes[0].run.time_s) > 4
    assert [outcome.row for outcome in outcomes] == [ONE, TWO]
    assert list(asdict(report.rows[0]))[:5] == ["filter", "gps", "imu", "profile", "rmse_x_m"]


def test_the_report_says_how_slow_gps_errors_are():
    error = table.gps_error("paper")
    assert (error["slow_variance_share"], error["correlation_time_s"]) == (0.9, 45.0)


def test_localisation_alone_runs(runner: Runner, result, monkeypatch: pytest.MonkeyPatch):
    """So what a row costs is what localisation costs; and the same code on the same recording has the same score."""
    monkeypatch.setattr("agents.pipeline.GroundEstimator", lambda *_: pytest.fail("estimates the ground"))
    outcome = result[1][0]
    again = table._replay(table.replay_task(ONE, outcome.drive), runner.cache)
    changes = {"us_per_second": 0.0}
    np.testing.assert_equal(asdict(replace(again, **changes)), asdict(replace(outcome.run, **changes)))


def test_pictures_are_drawn(result, runner: Runner, tmp_path: Path):
    cv2 = pytest.importorskip("cv2")
    plots = pytest.importorskip("evaluation.positions.plots", reason="needs the extra `eval`")
    paths = plots.draw(*result, runner, tmp_path)
    assert [p.name for p in paths] == ["table.png", "errors.png", "tracks_seed3.png"]
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture.shape[1] > 800
        assert picture.std() > 10


def test_a_configuration_that_never_had_a_pose_still_has_a_row(
    runner: Runner, result, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Without a single GPS fix the machine cannot know where it is."""
    monkeypatch.setattr(table, "configure", _deaf)
    run = table._replay(table.replay_task(ONE, result[1][0].drive), runner.cache)
    row = table.summarise(ONE, [run])
    assert row.covered == 0.0
    assert row.net_m != row.net_m  # NaN; the command prints null
    plots = pytest.importorskip("evaluation.positions.plots")
    assert plots.draw(result[0], [replace(result[1][0], run=run)], runner, tmp_path) == []


def _deaf(machine: MachineConfig, _: Configuration) -> tuple[MachineConfig, PipelineConfig]:
    sensors = tuple(replace(s, use=s.use and s.kind != "gps") for s in machine.sensors)
    return replace(machine, sensors=sensors), PipelineConfig()
