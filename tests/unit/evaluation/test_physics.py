import pytest

from evaluation import physics


def test_both_worlds_do_what_mechanics_says() -> None:
    said: list[str] = []
    found = physics.run([], said.append)
    rows = found["rows"]
    assert {row["world"] for row in rows} == {"pybullet", "fast"}
    assert {row["experiment"] for row in rows} == {"traction", "slope", "coast_down", "parking", "circle"}
    assert all(row["met"] for row in rows), [row for row in rows if not row["met"]]
    assert found["tours"] == []
    assert len(said) == 10


def test_a_goal_that_is_missed_is_told() -> None:
    row = physics._row("x", 1.02, 1.0, "m", relative=0.01)
    assert (row["met"], row["error"], row["goal"]) == (False, pytest.approx(0.02), pytest.approx(0.01))
    assert physics._row("x", 1.005, 1.0, "m", relative=0.01)["met"]
    assert not physics._row("x", 0.02, 0.0, "m", absolute=0.01)["met"]


def test_tours_are_driven_in_both_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(physics, "TOUR_S", 3.0)
    tours = physics.run([5], lambda _: None)["tours"]
    assert [tour["route"] for tour in tours] == ["west", "east", "middle"]
    assert all(0 < tour["position_rms_m"] < 0.1 for tour in tours)
