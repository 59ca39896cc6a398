import pytest

from lab.positions import parity
from tests.paths import SHARED_DATA as DATA

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (DATA / "rl_test2_jackal").is_dir(), reason="robot_localization's recordings are not here"),
]


def test_final_poses_are_those_that_robot_localization_asserts() -> None:
    rows = parity.run(DATA)
    assert {(row["log"], row["filter"]) for row in rows} == {
        (log, name) for log in ("rl_test1_husky", "rl_test2_jackal") for name in ("ekf", "ukf")
    }
    assert all(row["within"] for row in rows), rows


def test_a_pose_that_is_off_is_outside_of_its_tolerance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parity, "ASSERTED", {"rl_test2_jackal": {"ekf": ((9.0, 9.0, 9.0), 0.1)}})
    (row,) = parity.run(DATA)
    assert not row["within"]
    assert row["off_m"] > 5
