"""The table: rows from synthetic scores, and from short recordings."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from lab.campaign.recordings import PAPER, PlannedDrive, load, make
from lab.positions import experiment
from lab.positions.configurations import Configuration
from lab.positions.experiment import ratios, summarise
from sitegrid.logs.replay import Score

FAST = replace(PAPER, world="fast")
ONE, TWO = (Configuration("ukf", gps, 1, "default", 0.0) for gps in (1, 2))
SHARED = replace(TWO, machine_share=0.95)
DRIVE = PlannedDrive(3, 14.0, FAST.preset, FAST)


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
    """Per share: receivers that share all errors are worth one."""
    nets = {ONE: 2.0, TWO: 1.5, replace(ONE, machine_share=0.95): 2.0, SHARED: 1.9}
    pairs = ratios({row: [score(net), score(2 * net)] for row, net in nets.items()})
    assert [(r["ratio"], r["gps"], r["machine_share"], r["net"]) for r in pairs] == [
        ("one more receiver", 2, 0.0, 0.75),
        ("one more receiver", 2, 0.95, 0.95),
    ]


# --- on recordings ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("cache")
    make(DRIVE, folder)
    return folder


@pytest.mark.slow
def test_the_share_that_was_recorded_is_the_recording_itself(cache: Path):
    """Another share changes all fixes, but not their times, drive or seed."""
    recording = load(DRIVE.folder(cache))
    assert experiment._with_share(experiment.replay_task(TWO, DRIVE), cache) == recording
    shared = experiment._with_share(experiment.replay_task(SHARED, DRIVE), cache)
    pairs = list(zip(recording.readings, shared.readings, strict=True))
    assert all(a.stamp_ns == b.stamp_ns and a.sensor == b.sensor for a, b in pairs)
    assert {a.sensor for a, b in pairs if a != b} == {"gps-1", "gps-2", "gps-3"}
