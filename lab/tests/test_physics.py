import pytest

from lab import physics


@pytest.mark.slow
def test_both_worlds_do_what_mechanics_says() -> None:
    progress: list[str] = []
    report = physics.run([], progress.append)
    rows = report["rows"]
    assert {row["world"] for row in rows} == {"pybullet", "fast"}
    assert {row["experiment"] for row in rows} == {"traction", "slope", "coast_down", "parking", "circle"}
    assert all(row["met"] for row in rows), [row for row in rows if not row["met"]]
    assert report["tours"] == []
    assert len(progress) == 10


def test_a_missed_goal_is_shown() -> None:
    row = physics._row("x", 1.02, 1.0, "m", relative=0.01)
    assert (row["met"], row["error"], row["goal"]) == (False, pytest.approx(0.02), pytest.approx(0.01))
    assert physics._row("x", 1.005, 1.0, "m", relative=0.01)["met"]
    assert not physics._row("x", 0.02, 0.0, "m", absolute=0.01)["met"]


@pytest.mark.slow
def test_both_worlds_drive_the_same_tour_alike() -> None:
    """A whole lap over all soils and the slope, alone: where machines meet, a centimetre may decide who goes first."""
    tours = physics.tours([7], lambda _: None)
    assert [tour["route"] for tour in tours] == ["west", "east", "middle"]
    assert all(0 < tour["position_rms_m"] < 0.1 for tour in tours)
    assert all(0 < tour["speed_rms_mps"] < 0.05 for tour in tours)
