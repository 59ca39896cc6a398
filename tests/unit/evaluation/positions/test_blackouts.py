import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.pipeline import PipelineConfig, Positioning
from evaluation.campaign.experiment import Runner, Task
from evaluation.positions import blackouts
from evaluation.positions.blackouts import (
    BACK_S,
    BLACKOUT,
    GAP_S,
    LENGTHS_S,
    RECOVERY_S,
    SETTLED_S,
    START,
    Courses,
    Variant,
    after_gap,
    compare,
    placements_s,
    sensors_of,
    summarise,
    without_gps,
)
from protocol.errors import SitegridError
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Gps
from tests.unit.agents.drives import PROJECTION, S_BEND, SITE, START_NS, VEHICLE, Leg, drive


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


@pytest.mark.parametrize("seconds", [600.0, 1200.0])
def test_blackouts_begin_after_gps_was_known_and_end_within_the_drive(seconds: float) -> None:
    places = placements_s(seconds)
    assert len(places) == 4
    assert places[0] == SETTLED_S
    assert places[-1] + LENGTHS_S[-1] < seconds
    assert places[-1] + GAP_S + BACK_S[-1] < seconds


def test_drives_too_short_for_a_blackout_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SitegridError, match="400 is too short; blackouts need drives of 421 s"):
        blackouts.run(Runner(tmp_path), (0,), 400.0)


def test_after_a_gap_fixes_are_off_by_a_jump_that_fades() -> None:
    made = drive([*S_BEND, Leg(80)], VEHICLE)
    jumped = after_gap(made.readings, SITE, 3.0, -4.0)
    true = {r.stamp_ns: r for r in made.readings if isinstance(r, Gps)}
    fixes = [r for r in jumped if isinstance(r, Gps)]
    first_ns = made.readings[0].stamp_ns
    assert fixes[0].stamp_ns >= first_ns + GAP_S * 1e9
    assert len(jumped) - len(fixes) == len(without_gps(made.readings))
    for gps in fixes[:: len(fixes) // 5]:
        x, y, _ = PROJECTION.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        x0, y0, _ = PROJECTION.to_map(true[gps.stamp_ns].lat_deg, true[gps.stamp_ns].lon_deg, gps.height_m)
        left = math.exp(-((gps.stamp_ns - first_ns) * 1e-9 - GAP_S) / RECOVERY_S)
        assert (x - x0, y - y0) == pytest.approx((3 * left, -4 * left), abs=1e-3)


def test_without_the_reference_one_receiver_one_gyro_and_the_wheels_are_left() -> None:
    machine = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("ahrs", "attitude")))
    used = {name: [s.name for s in sensors_of(machine, name).sensors if s.use] for name in blackouts.SENSORS}
    assert used == {"reference": ["imu", "torque", "wheels", "gps-1", "ahrs"], "gyro": used["reference"][:-1]}


@pytest.mark.slow
def test_a_copy_goes_on_as_the_original_would_and_leaves_it_as_it_was() -> None:
    made = drive([*S_BEND, Leg(30)], VEHICLE)
    (early, rest), (late, _) = blackouts._forks(
        Positioning(SITE, VEHICLE, PipelineConfig()), made.readings, [20.0, 40.0]
    )
    assert early.pose
    assert early.pose.stamp_ns < START_NS + 20.1e9
    early.step([r for r in rest if r.stamp_ns < made.readings[0].stamp_ns + 40_000_000_000])
    assert late.pose
    assert (early.pose.x_m, early.pose.y_m) == (late.pose.x_m, late.pose.y_m)


def test_a_report_judges_the_goals_on_rows_and_on_ratios(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The profile `paper` twice as far off, with a covariance that is right for `default`."""
    sizes = {BLACKOUT: (4, LENGTHS_S[-1]), START: (1, 599), **dict.fromkeys(blackouts.JUMPS, (4, GAP_S + BACK_S[-1]))}

    def solved(_: Runner, __: object, tasks: list[Task[Variant]]) -> list[Courses]:
        sizes_of = [(sizes[task.variant.case], task.variant.profile) for task in tasks]
        return [courses(0.03 if p == "default" else 0.06, 10.0, *size) for size, p in sizes_of]

    monkeypatch.setattr(Runner, "run", solved)
    report, outcomes = blackouts.run(Runner(tmp_path), (0, 1), 600.0)
    assert len(report["goals"]) == 2 * len(LENGTHS_S) + 3
    assert all(goal["met"] for goal in report["goals"])
    assert {row["ratio"] for row in report["ratios"] if row["seconds"] == 300} == {0.5}
    assert len(outcomes) == 2 * 4 * 4
