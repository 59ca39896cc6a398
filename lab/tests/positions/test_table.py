"""The table: its rows on made-up scores, and on short recordings."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from lab.campaign.experiment import Runner
from lab.campaign.recordings import PAPER, PlannedDrive, load
from lab.positions import table
from lab.positions.configurations import Configuration
from lab.positions.table import paired_ratio, ratios, summarise
from protocol.machine.machine_config import MachineConfig
from sitegrid.logs.replay import Score
from sitegrid.proof.figures import Report

FAST = replace(PAPER, world="fast")
ONE, TWO, NONE = (Configuration("ukf", gps, 1, "default", 0.0) for gps in (1, 2, 0))
SHARED = replace(TWO, machine_share=0.95)
NEVER = Configuration("ukf", 9, 1, "default")
SECONDS = 14.0
DRIVE = PlannedDrive(3, SECONDS, FAST.preset, FAST)


def score(net_m: float, max_m: float = 3.0, us: float = 100.0, smoothed: tuple[float, ...] = (math.nan,) * 3) -> Score:
    return Score(0.6 * net_m, 0.8 * net_m, net_m, max_m, 2.0, 1.0, 3.0, 0.95, 0.98, us, *smoothed)


def test_row_has_means_over_seeds_and_stands_beside_the_paper():
    row = summarise(ONE, [score(1.0, 4.0), score(2.0, 7.0, 300.0)])
    assert (row["filter"], row["gps"], row["imu"], row["profile"]) == ("ukf", 1, 1, "default")
    assert (row["rmse_x_m"], row["rmse_y_m"], row["net_m"]) == (0.9, 1.2, 1.5)
    assert (row["max_m"], row["us_per_second"]) == (7.0, 200)
    assert row["paper_net_m"] == 2.3234
    assert row["difference_m"] == pytest.approx(1.5 - 2.3234)
    assert row["net_by_seed_m"] == [1.0, 2.0]
    assert row["nees_95"] == pytest.approx([2 - 0.707, 2 + 0.707])
    assert row["ci95_m"] == pytest.approx(12.7062 * math.sqrt(0.5) / math.sqrt(2), abs=1e-3)


def test_a_single_seed_has_no_interval_and_a_row_of_ours_no_figure_of_the_paper():
    row = summarise(Configuration("ukf", 3, 1, "default"), [score(1.0)])
    assert row["ci95_m"] is None
    assert row["paper_net_m"] is row["difference_m"] is None


def test_pairing_takes_out_what_recordings_have_in_common():
    hard = np.random.default_rng(6).uniform(1, 4, 12)
    ratio, half = paired_ratio(0.7 * hard, hard)
    assert ratio == pytest.approx(0.7)
    assert half == pytest.approx(0.0, abs=1e-12)


def test_ratios_are_of_profiles_and_of_filters_that_were_both_run():
    rows = {(f, p): Configuration(f, 1, 1, p) for f, p in (("ukf", "paper"), ("ukf", "default"), ("ekf", "default"))}
    net = {("ukf", "paper"): 2.0, ("ukf", "default"): 1.0, ("ekf", "default"): 1.1}
    pairs = ratios({row: [score(net[key]), score(2 * net[key])] for key, row in rows.items()})
    assert [(r["ratio"], r["filter"], r["profile"], r["net"]) for r in pairs] == [
        ("default/paper", "ukf", "default", 0.5),
        ("ekf/ukf", "ekf", "default", 1.1),
    ]
    assert ratios({ONE: [score(1.0)]}) == []


def test_one_more_receiver_is_compared_on_the_same_fixes():
    """Of shares, each with its own: receivers that share all they err are worth no more than one."""
    nets = {ONE: 2.0, TWO: 1.5, replace(ONE, machine_share=0.95): 2.0, SHARED: 1.9}
    pairs = ratios({row: [score(net), score(2 * net)] for row, net in nets.items()})
    assert [(r["ratio"], r["gps"], r["machine_share"], r["net"]) for r in pairs] == [
        ("one more receiver", 2, 0.0, 0.75),
        ("one more receiver", 2, 0.95, 0.95),
    ]


def test_smoothed_poses_stand_beside_the_live_ones_of_the_same_drives():
    runs = [score(2.0, smoothed=(1.5, 1.8, 0.96)), score(4.0, smoothed=(3.3, 2.2, 0.94))]
    row = summarise(ONE, runs)
    assert (row["smoothed_net_m"], row["smoothed_nees"], row["smoothed_coverage95"]) == (2.4, 2.0, 0.95)
    (ratio,) = ratios({ONE: runs})
    assert (ratio["ratio"], ratio["net"]) == ("smoothed/live", 0.8)


# --- on recordings ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def result(runner: Runner) -> tuple[Report, table.Scores]:
    return table.run(runner, (3,), SECONDS, (replace(ONE, machine_share=None), TWO, NONE, SHARED, NEVER), FAST)


@pytest.mark.slow
def test_rows_are_scored_on_one_recording_and_what_cannot_run_is_named(result, runner: Runner):
    report, scores = result
    rows = report["rows"]
    shown = [(row["gps"], row["machine_share"], row["paper_net_m"]) for row in rows]
    assert shown == [(1, 0, 2.3234), (2, 0, 1.7217), (0, 0, 65.4774), (2, 0.95, 1.7217)]
    assert all(0.05 < row["net_m"] < 8 and 0.3 < row["covered"] < 1 for row in (*rows[:2], rows[3]))
    assert rows[1]["net_m"] != rows[3]["net_m"]
    assert all(0.05 < row["smoothed_net_m"] < 8 and row["smoothed_coverage95"] > 0.3 for row in rows[:2])
    assert rows[2]["covered"] == 1  # without GPS its start is given
    assert all(row["us_per_second"] > 100 for row in rows)
    assert [row["gps"] for row in report["missing"]] == [9]
    assert "9" in report["missing"][0]["why"]
    assert len(list(runner.cache.glob("paper-seed3-*"))) == 1
    assert list(scores) == [ONE, TWO, NONE, SHARED]
    assert list(rows[0])[:6] == ["filter", "gps", "imu", "profile", "machine_share", "rmse_x_m"]


@pytest.mark.slow
def test_the_share_that_was_recorded_is_the_recording_itself(runner: Runner, result):
    """And another one changes what all receivers read, but not when: the drive and the seed are the same."""
    recording = load(DRIVE.folder(runner.cache))
    assert table._with_share(table.replay_task(TWO, DRIVE), runner.cache) == recording
    shared = table._with_share(table.replay_task(SHARED, DRIVE), runner.cache)
    pairs = list(zip(recording.readings, shared.readings, strict=True))
    assert all(a.stamp_ns == b.stamp_ns and a.sensor == b.sensor for a, b in pairs)
    assert {a.sensor for a, b in pairs if a != b} == {"gps-1", "gps-2", "gps-3"}


def test_the_report_says_how_slow_gps_errors_are():
    error = table.gps_error(PlannedDrive(0, 1.0))
    assert (error["slow_variance_share"], error["correlation_time_s"]) == (0.9, 45.0)


@pytest.mark.slow
def test_localisation_alone_runs(runner: Runner, result, monkeypatch: pytest.MonkeyPatch):
    """So what a row costs is what localisation costs; and the same code on the same recording has the same score."""
    monkeypatch.setattr("agents.pipeline.GroundEstimator", lambda *_: pytest.fail("estimates the ground"))
    again = table._replay(table.replay_task(ONE, DRIVE), runner.cache)
    changes = {"us_per_second": 0.0}
    np.testing.assert_equal(asdict(replace(again, **changes)), asdict(replace(result[1][ONE][0], **changes)))


@pytest.mark.slow
def test_a_configuration_that_never_had_a_pose_still_has_a_row(runner: Runner, result, monkeypatch: pytest.MonkeyPatch):
    """Without a single GPS fix the machine cannot know where it is."""
    monkeypatch.setattr(table, "select", _deaf)
    run = table._replay(table.replay_task(ONE, DRIVE), runner.cache)
    row = table.summarise(ONE, [run])
    assert row["covered"] == 0.0
    assert math.isnan(row["net_m"])  # the command prints null


def _deaf(machine: MachineConfig, *_: int) -> MachineConfig:
    return replace(machine, sensors=tuple(replace(s, use=s.use and s.kind != "gps") for s in machine.sensors))
