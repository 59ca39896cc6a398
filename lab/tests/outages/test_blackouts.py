from pathlib import Path

import numpy as np
import pytest

from lab.campaign.experiment import Runner, Task
from lab.outages import blackouts
from lab.outages.blackouts import Variant, compare, summarise
from lab.outages.replays import BLACKOUT, LENGTHS_S, START, Courses, Filtering, sizes
from protocol.errors import SitegridError


def courses(metres_per_s: float, std_m: float, n: int = 4, seconds: int = LENGTHS_S[-1]) -> Courses:
    """Errors that grow evenly to the east."""
    error = np.zeros((n, seconds + 1, 2))
    error[..., 0] = metres_per_s * np.arange(seconds + 1)
    return Courses(error, np.broadcast_to(np.eye(2) * std_m**2, (n, seconds + 1, 2, 2)))


def test_a_row_has_the_errors_at_its_end() -> None:
    rows = summarise(Variant(BLACKOUT, "gyro", "default"), [courses(0.1, 5.0), courses(0.3, 5.0)])
    assert [row["seconds"] for row in rows] == list(LENGTHS_S)
    assert rows[-1]["error_m"] == pytest.approx(60.0)
    assert rows[-1]["error_by_seed_m"] == [30.0, 90.0]
    assert [row["coverage95"] for row in rows] == [1.0, 1.0, 0.5, 0.5, 0.0]  # 12.24 m are inside


def test_the_worst_seed_and_each_course_are_compared_with_paper() -> None:
    """Better on average, worse on one seed; over: courses with more than 1.5 times the error of the same one."""
    runs = {
        Variant(BLACKOUT, "gyro", "default"): [courses(0.1, 1.0), courses(0.32, 1.0)],
        Variant(BLACKOUT, "gyro", "paper"): [courses(0.4, 1.0), courses(0.2, 1.0)],
    }
    last = compare(BLACKOUT, "gyro", runs)[-1]
    assert (last["ratio"], last["worst_seed"]) == pytest.approx((0.7, 1.6))
    assert (last["over"], last["courses"]) == (4, 8)


def test_a_drive_from_a_start_is_looked_at_up_to_its_end() -> None:
    rows = summarise(Variant(START, "gyro", "default"), [courses(0.1, 1.0, n=1, seconds=599)])
    assert [row["seconds"] for row in rows] == [60, 300, 599]


def test_drives_too_short_for_a_blackout_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SitegridError, match="400 is too short; blackouts need drives of 421 s"):
        blackouts.run(Runner(tmp_path), (0,), 400.0)


def test_a_report_judges_the_goals_on_rows_and_on_ratios(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The profile `paper` twice as far off, with a covariance that is right for `default`."""

    def solved(_: Runner, __: object, tasks: list[Task[Filtering]]) -> list[Courses]:
        n = sum(n for n, _ in sizes(600.0).values())
        return [courses(0.03 if t.variant.profile == "default" else 0.06, 10.0, n, 599) for t in tasks]

    monkeypatch.setattr(Runner, "run", solved)
    report, outcomes = blackouts.run(Runner(tmp_path), (0, 1), 600.0)
    assert len(report["goals"]) == 2 * len(LENGTHS_S) + 3
    assert all(goal["met"] for goal in report["goals"])
    assert {row["ratio"] for row in report["ratios"] if row["seconds"] == 300} == {0.5}
    assert len(outcomes) == 2 * 4 * 4
