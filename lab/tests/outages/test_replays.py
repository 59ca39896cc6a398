import math
from dataclasses import replace

import numpy as np
import pytest

from agents.positioning import PipelineConfig, Positioning
from lab.outages import replays
from lab.outages.replays import (
    BACK_S,
    BLACKOUT,
    CASES,
    GAP_S,
    JUMPS,
    LENGTHS_S,
    RECOVERY_S,
    SENSORS,
    SETTLED_S,
    START,
    Courses,
    after_gap,
    placements_s,
    sensors_of,
    sizes,
)
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Gps
from tests.unit.agents.drives import PROJECTION, S_BEND, SITE, START_NS, VEHICLE, Leg, drive


@pytest.mark.parametrize("seconds", [600.0, 1200.0])
def test_blackouts_begin_after_gps_was_known_and_end_within_the_drive(seconds: float) -> None:
    places = placements_s(seconds)
    assert len(places) == 4
    assert places[0] == SETTLED_S
    assert places[-1] + LENGTHS_S[-1] < seconds
    assert places[-1] + GAP_S + BACK_S[-1] < seconds


def test_after_a_gap_fixes_are_off_by_a_jump_that_fades() -> None:
    made = drive([*S_BEND, Leg(80)], VEHICLE)
    jumped = after_gap(made.readings, SITE, 3.0, -4.0)
    true = {r.stamp_ns: r for r in made.readings if isinstance(r, Gps)}
    fixes = [r for r in jumped if isinstance(r, Gps)]
    first_ns = made.readings[0].stamp_ns
    assert fixes[0].stamp_ns >= first_ns + GAP_S * 1e9
    assert len(jumped) - len(fixes) == len(replays.without_gps(made.readings))
    for gps in fixes[:: len(fixes) // 5]:
        x, y, _ = PROJECTION.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        x0, y0, _ = PROJECTION.to_map(true[gps.stamp_ns].lat_deg, true[gps.stamp_ns].lon_deg, gps.height_m)
        left = math.exp(-((gps.stamp_ns - first_ns) * 1e-9 - GAP_S) / RECOVERY_S)
        assert (x - x0, y - y0) == pytest.approx((3 * left, -4 * left), abs=1e-3)


def test_without_the_reference_one_receiver_one_gyro_and_the_wheels_are_left() -> None:
    machine = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("ahrs", "attitude")))
    used = {name: [s.name for s in sensors_of(machine, name).sensors if s.use] for name in SENSORS}
    assert used == {"reference": ["imu", "torque", "wheels", "gps-1", "ahrs"], "gyro": used["reference"][:-1]}


@pytest.mark.slow
def test_a_copy_goes_on_as_the_original_would_and_leaves_it_as_it_was() -> None:
    made = drive([*S_BEND, Leg(30)], VEHICLE)
    (early, rest), (late, _) = replays._forks(Positioning(SITE, VEHICLE, PipelineConfig()), made.readings, [20.0, 40.0])
    assert early.pose
    assert early.pose.stamp_ns < START_NS + 20.1e9
    early.step([r for r in rest if r.stamp_ns < made.readings[0].stamp_ns + 40_000_000_000])
    assert late.pose
    assert (early.pose.x_m, early.pose.y_m) == (late.pose.x_m, late.pose.y_m)


def test_each_case_has_its_own_courses_of_those_of_a_drive() -> None:
    """One below the other: four of the blackout, four of each jump, one from the start, the longest."""
    n = sum(n for n, _ in sizes(600.0).values())
    error = np.arange(n)[:, None, None] + np.zeros((n, 600, 2))
    by_case = Courses(error, np.zeros((n, 600, 2, 2))).by_case(600.0)
    assert list(by_case) == list(CASES)
    lengths = {case: courses.error_m.shape[1] - 1 for case, courses in by_case.items()}
    assert lengths == {BLACKOUT: LENGTHS_S[-1], **dict.fromkeys(JUMPS, GAP_S + BACK_S[-1]), START: 599}
    assert np.concatenate([courses.error_m[:, 0, 0] for courses in by_case.values()]).tolist() == list(range(n))


@pytest.mark.slow
def test_a_receiver_that_comes_back_is_missed_for_a_minute_as_in_a_blackout() -> None:
    """What was believed when it came back is the same in all cases; then the errors part."""
    made = drive([*S_BEND, Leg(80)], VEHICLE)
    core, rest = replays._forks(Positioning(SITE, VEHICLE, PipelineConfig()), made.readings, [20.0])[0]
    assert (rest[-1].stamp_ns - rest[0].stamp_ns) * 1e-9 > GAP_S + 5
    traces = replays._lost(core, rest, SITE, 0.0)
    blackout, jump = traces[BLACKOUT], traces["jump-15m"]
    gap = int((blackout.since_start_s < GAP_S).sum())
    np.testing.assert_array_equal(blackout.position_m[:gap], jump.position_m[:gap])
    assert np.abs(blackout.position_m[-1] - jump.position_m[-1]).max() > 0.5
