"""The ground's table on short recordings."""

import math
from dataclasses import replace

import pytest

from lab.campaign.experiment import Runner
from lab.campaign.recordings import Setup
from lab.ground import experiment
from lab.ground.experiment import GroundConfiguration
from sitegrid.proof.figures import Report

FAST = Setup("paper_site", ("west", "east"), gps=(1, 2), imu=(3,), world="fast")
CALIBRATED, HARSH = GroundConfiguration("kalman", "calibrated"), GroundConfiguration("kalman", "harsh")
SECONDS = 40.0


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[Report, list[experiment.GroundOutcome]]:
    return experiment.run(runner, (4,), SECONDS, (CALIBRATED, HARSH), FAST)


@pytest.mark.slow
def test_every_row_is_judged_on_its_presets_recording(result, runner: Runner):
    report, outcomes = result
    assert [(row["estimator"], row["preset"]) for row in report["rows"]] == [
        ("kalman", "calibrated"),
        ("kalman", "harsh"),
    ]
    assert [outcome.drive.preset for outcome in outcomes] == ["dgps", "harsh"]
    assert sorted(p.name.split("-")[0] for p in runner.cache.iterdir()) == ["dgps", "ground", "harsh"]
    for row in report["rows"]:
        assert row["samples"] > row["judged_samples"] > 20
        assert row["cells"] > 20
        assert row["right_class_ci95"] is None  # of a single seed
        assert len(row["c_rr_bias_by_seed"]) == 1
    assert report["judged_from_s"] == 16.0
    assert [goal["name"] for goal in report["goals"]] == [goal.figure for goal in experiment.GOALS]
    assert {goal["row"] for goal in report["goals"]} == {"kalman calibrated"}
    assert (outcomes[0].output.samples["stamp_ns"] > 0).all()


def test_rows_configure_the_estimator_and_its_calibration():
    options = {row.name: row.options.estimation for row in experiment.ROWS}
    assert len(options) == 6
    assert {(e.estimator, e.calibrate) for e in options.values()} == {
        (name, calibrate) for name in ("kalman", "rls") for calibrate in (True, False)
    }
    assert not options["kalman-nominal"].calibrate


@pytest.mark.parametrize(("seconds", "settled"), [(600.0, 240.0), (1200.0, 240.0), (100.0, 40.0)])
def test_a_machine_has_time_to_settle(seconds, settled):
    assert experiment.settle_s(seconds) == settled


@pytest.mark.slow
def test_a_tour_without_samples_still_has_rows(result, runner: Runner):
    _, (outcome, _) = result
    nothing = replace(outcome.output, samples=outcome.output.samples[:0])
    silent = experiment.judged(outcome.drive, outcome.row, nothing, runner.cache)
    row = experiment.summarise(CALIBRATED, [silent, silent])
    assert row["cells"] == 0
    assert math.isnan(row["right_class_pct"])
