from pathlib import Path

import numpy as np
import pytest

from protocol.wire.messages import Pose
from sitegrid.proof.tracks import Truth, position_rmse, read_track

START_NS = 1_767_225_600_000_000_000


def pose(name: str, seconds: float, x_m: float, y_m: float) -> Pose:
    return Pose(name, START_NS + round(seconds * 1e9), x_m, y_m, 0.0, 1.0, 1.0, 0.0, 1.0)


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """Machine `a` drives east with 2 m/s, machine `b` stands at (5, -5)."""
    (tmp_path / "tracks").mkdir()
    for name, place in (("a", lambda t: (2.0 * t, 0.0)), ("b", lambda _: (5.0, -5.0))):
        lines = [f"{START_NS + t * 10**9},{place(t)[0]},{place(t)[1]}" for t in range(11)]
        (tmp_path / "tracks" / f"{name}.csv").write_text("\n".join(["stamp_ns,x,y", *lines]) + "\n")
    return tmp_path


def test_true_positions_have_no_error_also_between_the_truths_stamps(truth):
    poses = [pose("a", t, 2.0 * t, 0.0) for t in (0.0, 0.25, 3.7, 10.0)]
    assert position_rmse({"a": poses}, truth)["a"] == pytest.approx(0.0, abs=1e-5)  # doubles are good to 256 ns


def test_error_is_the_root_mean_square_in_the_plane(truth):
    poses = {
        "a": [pose("a", 1.0, 2.0 + 3.0, 4.0), pose("a", 2.0, 4.0, 0.0)],  # 5 m and 0 m off
        "b": [pose("b", t, 5.0, -7.0) for t in range(10)],
    }
    assert position_rmse(poses, truth) == pytest.approx({"a": (25 / 2) ** 0.5, "b": 2.0}, abs=1e-5)


def test_a_machine_without_a_track_is_an_error(truth):
    with pytest.raises(FileNotFoundError):
        position_rmse({"c": [pose("c", 0.0, 0.0, 0.0)]}, truth)


def test_truth_is_interpolated_and_unknown_beyond_its_ends():
    truth = Truth(START_NS + np.array([0, 10**9]), np.array([[0.0, 5.0], [4.0, 5.0]]))
    places = truth.at(START_NS + np.array([-1, 0, 250_000_000, 10**9, 10**9 + 1]))
    assert places[1:4] == pytest.approx(np.array([[0.0, 5.0], [1.0, 5.0], [4.0, 5.0]]))
    assert np.isnan(places[[0, 4]]).all()


def test_track_of_a_simulation_keeps_exact_stamps(tmp_path: Path):
    (tmp_path / "a.csv").write_text(f"stamp_ns,x,y,z\n{START_NS + 1},1.5,2.5,0\n{START_NS + 100_000_001},2.5,3.5,0\n")
    truth = read_track(tmp_path / "a.csv")
    assert truth.stamp_ns.tolist() == [START_NS + 1, START_NS + 100_000_001]
    assert truth.position_m.tolist() == [[1.5, 2.5], [2.5, 3.5]]
