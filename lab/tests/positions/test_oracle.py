"""The batch optimum: of linear models it is the smoother of the whole run, of a drive it is close to it."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief, Measurement, Motion, anchor_states, open_states, reset_states
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.smoother import nothing_past
from lab.campaign.experiment import Runner
from lab.campaign.recordings import PAPER
from lab.positions import oracle, table
from lab.positions.batch_optimum import optimum
from lab.positions.configurations import Configuration
from lab.positions.filter_steps import StepRecorder
from lab.positions.oracle import OracleRun, summarise
from sitegrid.door import run as sitegrid

EKF = Configuration("ekf", 1, 1, "default")
SECOND_NS = 1_000_000_000


def test_of_linear_models_it_is_the_smoother_of_the_whole_run() -> None:
    """With motions, measurements, and all changes of a belief."""
    pytest.importorskip("gtsam", reason="needs the extra `oracle`")
    rng, n, states = np.random.default_rng(7), 8, slice(6, 8)
    root = rng.normal(size=(n, n))
    recorder = StepRecorder(Ekf())
    belief = Belief(0, rng.normal(size=n), root @ root.T + np.eye(n), past=nothing_past(n, 1000.0))
    for i in range(1, 30):
        F, H = 0.9 * np.eye(n) + 0.2 * rng.normal(size=(n, n)), rng.normal(size=(2, n))
        moves = Motion(lambda x, F=F: x @ F.T, lambda _, F=F: F, np.eye(n) * 0.1, ())
        belief = recorder.predict(belief, moves, i * SECOND_NS)
        if i % 7 == 3:
            anchor = np.where(np.arange(n) < 6, H, 0.0)
            kinds = (reset_states(belief, states, 0.7), anchor_states(belief, states, anchor, 0.7))
            belief = (*kinds, open_states(belief, states, np.eye(2)))[i // 7 % 3]
        z, R = rng.normal(size=2), 0.3 * np.eye(2)
        belief = recorder.condition(belief, Measurement("a", 0, z, R, lambda x, H=H: x @ H.T, lambda _, H=H: H)).belief
    assert belief.past
    best = optimum(recorder.steps(belief))
    for pose in belief.past.poses(belief.stamp_ns, belief.x, belief.P):
        assert best[pose.stamp_ns][:2] == pytest.approx((pose.x_m, pose.y_m), abs=1e-6)


@pytest.mark.slow
def test_smoothed_poses_of_a_drive_are_close_to_the_optimum(tmp_path_factory: pytest.TempPathFactory) -> None:
    pytest.importorskip("gtsam", reason="needs the extra `oracle`")
    runner = Runner(tmp_path_factory.mktemp("cache"))
    rows = (EKF, replace(EKF, filter="ukf"), replace(EKF, gps=0))
    _, outcomes = table.run(runner, (3,), 14.0, rows, replace(PAPER, world="fast"))
    (judged,) = oracle.run(runner, outcomes)
    assert (judged["filter"], judged["gps"]) == ("ekf", 1)
    assert 0.001 < judged["apart_m"] < 0.3
    assert judged["whole_over_optimum"] == pytest.approx(1.0, abs=0.2)
    assert judged["whole_net_m"] == pytest.approx(judged["smoothed_net_m"], abs=1e-4)  # shorter than the lag


def test_a_row_has_means_and_paired_ratios() -> None:
    row = summarise(EKF, [OracleRun(1.0, 1.01, 1.1, 1.3, 0.02), OracleRun(2.0, 2.02, 2.2, 2.6, 0.04)])
    assert (row["optimum_net_m"], row["apart_m"]) == (1.5, 0.03)
    assert (row["whole_over_optimum"], row["smoothed_over_optimum"], row["live_over_optimum"]) == (1.01, 1.1, 1.3)
    assert row["whole_ci95"] == pytest.approx(0.0, abs=1e-9)


def test_without_gtsam_the_command_says_at_once_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert sitegrid(["eval", "localisation", "--oracle"]) == 1
    assert capsys.readouterr().err == (
        "sitegrid: gtsam is not installed: pip install '.[eval,oracle]' in the folder of this project\n"
    )
