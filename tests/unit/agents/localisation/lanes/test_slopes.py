"""Laws of slopes: none of level, new or unknown ground; valid covariances, no slope used twice, visible map shifts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.filters.belief import Belief
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.filters.ukf import Ukf
from agents.localisation.lanes.aid import SLOPES, LaneAid
from agents.localisation.lanes.guards import prior_m2
from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.lanes.slopes import AFTER_NS, PROFILE_M, GradeProfile, SlopeWindow, match_slopes
from agents.localisation.lanes.window import LONGEST_NS
from protocol.machine.samples import empty
from protocol.queries.lanes import SHAPE, SLOPE_CELLS, SLOPE_STEP, UNKNOWN_SLOPE, LaneTile

LAYOUT = Layout(imus=1, lanes=True)
BIAS = 0.008  # of the accelerometer, as a slope
EAST, BACK = 0.0, math.pi


def waves(x_m):
    """Slope eastward of ground that undulates, in waves of 16 and 37 m."""
    return 0.007 * np.sin(2 * np.pi * x_m / 16) + 0.005 * np.sin(2 * np.pi * x_m / 37 + 1)


def slope_map(slope_east, moved_m=0.0):
    """Ground that slopes east alone, 80 m and more around the origin."""
    tiles = {}
    for x in range(-8, 8):
        x_m = 16 * x + SLOPE_CELLS * (np.arange(4) + 0.5) - moved_m
        steps = np.rint(slope_east(x_m) / SLOPE_STEP)
        slopes = np.zeros((2, 4, 4), np.int8)
        slopes[0] = steps
        for y in (-1, 0):
            tiles[x, y] = LaneTile(x, y, 1, 9, 2, 3, np.zeros(SHAPE, np.uint8), slopes.reshape(2, 16))
    return LaneMap(1.0, tiles)


def profile(heading_rad, slope=waves, noise=0.001):
    """What a machine feels that ends at the origin, and has a bias."""
    back_m = np.stack([-np.arange(0, PROFILE_M, 0.5) * math.cos(heading_rad), np.zeros(round(2 * PROFILE_M))], axis=1)
    felt = slope(back_m[:, 0]) * math.cos(heading_rad) + BIAS
    felt += np.random.default_rng(4).normal(0, noise, len(felt))
    return GradeProfile(felt, back_m, np.full(len(felt), heading_rad))


def level(x_m):
    return 0 * x_m


def test_the_map_has_the_gradient_between_its_parts_and_nan_beyond():
    lanes = slope_map(lambda x_m: 0.0005 * x_m)
    x_m = np.array([[-20.0, 0.0], [3.0, 70.0]])
    east, north = lanes.gradient(x_m, np.zeros((2, 2)))
    np.testing.assert_allclose(east, 0.0005 * x_m, atol=0.7 * SLOPE_STEP)
    assert not north.any()
    assert np.isnan(lanes.gradient(np.array([0.0, 200.0]), np.array([40.0, 0.0]))).all()
    half = {at: replace(tile, slopes=np.full((2, 16), UNKNOWN_SLOPE, np.int8)) for at, tile in lanes.tiles.items()}
    assert np.isnan(LaneMap(1.0, half).gradient(x_m, np.zeros((2, 2)))).all()


@pytest.mark.parametrize("moved_m", [-4.0, -1.0, 0.0, 2.0, 5.0])
@pytest.mark.parametrize("heading_rad", [EAST, BACK])
def test_a_map_that_is_shifted_shifts_the_place_and_a_machine_that_comes_back_sees_the_mirror_image(
    moved_m, heading_rad
):
    shown = match_slopes(slope_map(waves, moved_m), np.zeros(2), 9.0, heading_rad, profile(heading_rad))
    ahead_m, variance_m2 = shown
    assert ahead_m == pytest.approx(moved_m * math.cos(heading_rad), abs=math.sqrt(variance_m2))
    assert 1.0 < variance_m2 < 3.0  # at least that of the map


def test_ground_that_is_level_or_new_or_unknown_tells_nothing():
    undulates = slope_map(waves)
    for lanes, felt, why in (
        (slope_map(level), profile(EAST), "flat"),
        (slope_map(level), profile(EAST, level), "flat"),
        (undulates, profile(EAST, level), "flat"),
        (undulates, profile(EAST, lambda x_m: waves(-x_m + 31.0)), "flat"),  # shaped anew
        (undulates, profile(EAST, lambda x_m: waves(x_m) + 0.1 * (x_m > -30)), "unfit"),  # a ramp has come
        (slope_map(waves, 60.0), replace(profile(EAST), back_m=profile(EAST).back_m + 150.0), "unknown"),
        (LaneMap(1.0), profile(EAST), "unknown"),
    ):
        assert match_slopes(lanes, np.zeros(2), 9.0, EAST, felt) == why


def drive(window, from_m, to_m, begin_s, slope=waves, speed_mps=5.0, late_m=10.0):
    """Drive on an axis with slopes that come late; returns where dead reckoning is."""
    at = None
    for step in range(round(2 * (to_m - from_m)) + 1):
        x_m = from_m + step / 2
        stamp_ns = round((begin_s + step / 2 / speed_mps) * 1e9)
        at = DeadReckonedPose(stamp_ns, 0.0, 0.0, x_m, 0.0)
        window.add(at)
        if step / 2 >= late_m:
            window.feel(stamp_ns - round(late_m / speed_mps * 1e9), float(slope(x_m - late_m)), 0.5)
    return at


def test_every_slope_is_in_one_profile_where_it_was_felt():
    window, seen, ends = SlopeWindow(2.0), [], 0
    begin_s = AFTER_NS * 1e-9
    window.feel(1, 0.0, 0.5)  # from then on it counts
    for number in range(30):
        at = drive(window, 20.5 * number, 20.5 * number + 20, begin_s + 4.1 * number, late_m=0.0)
        if shown := window.end(at, math.pi / 2):
            assert len(shown.slope) >= 2 * PROFILE_M
            np.testing.assert_allclose(shown.heading_rad, math.pi / 2)
            x_m = at.x_m + shown.back_m[:, 1] - 2.0  # dead reckoning's east is the map's north
            np.testing.assert_allclose(shown.slope, waves(x_m), atol=1e-9)
            seen += x_m.round(3).tolist()
            ends += 1
    assert ends == 7
    assert len(set(seen)) == len(seen)


def test_slopes_of_the_first_minute_of_a_long_stop_and_unknown_ones_are_left_out():
    window = SlopeWindow(0.0)
    at = drive(window, 0.0, 150.0, 1.0)  # 30 s
    assert window.end(at, 0.0) is None
    at = drive(window, 150.0, 400.0, 100.0, slope=lambda _: math.nan)
    assert window.end(at, 0.0) is None
    at = drive(window, 400.0, 450.0, 200.0)
    at = drive(window, 450.0, 500.0, 211.0 + LONGEST_NS * 1e-9)
    assert window.end(at, 0.0) is None
    assert window.end(drive(window, 500.0, 550.0, 222.0 + LONGEST_NS * 1e-9), 0.0)


@pytest.mark.parametrize("engine", [Ekf(), Ukf()])
@pytest.mark.parametrize("slope", [waves, level])
def test_windows_leave_a_covariance_and_level_ground_changes_no_bit(engine, slope):
    aid = LaneAid(0.0)
    aid.lanes = slope_map(slope)
    x = np.zeros(LAYOUT.n)
    x[YAW], x[0] = 0.0, 2.0
    P = np.diag(np.full(LAYOUT.n, 0.01))
    P[:2, :2], P[-3:, -3:] = [[2.5, 0.3], [0.3, 1.0]], np.diag(prior_m2(young=False))
    belief = start = Belief(10**9, x, P)
    begin_s = 2 * AFTER_NS * 1e-9
    aid.feel(empty(1))
    aid.is_due(DeadReckonedPose(1, 0.0, 0.0, -200.0, 0.0))
    assert aid.measurement(belief) is None  # the guards' time begins
    for number in range(12):
        rows = empty(200)
        x_m = np.linspace(-100, -0.5, 200)
        rows["stamp_ns"] = (begin_s + 30 * number + (x_m + 100) / 5) * 1e9
        rows["grade_e"], rows["grade_n"], rows["distance_m"] = waves(x_m) + BIAS, 0.3, 0.5
        for row, at_m in zip(rows, x_m, strict=True):
            aid.is_due(DeadReckonedPose(int(row["stamp_ns"]), 0.0, 0.0, at_m, 0.0))
        aid.feel(rows)
        belief = replace(belief, stamp_ns=int(rows["stamp_ns"][-1]))
        if measurement := aid.slope_measurement(belief):
            conditioned = engine.condition(belief, measurement)
            assert conditioned.accepted
            belief = conditioned.belief
            assert np.linalg.eigvalsh(belief.P)[0] > 0
            assert aid.slope_measurement(belief) is None  # the same slopes once more
    if slope is level:
        assert aid.counters == {f"{SLOPES}_flat": 12}
        np.testing.assert_array_equal(belief.x, start.x)
        np.testing.assert_array_equal(belief.P, start.P)
    else:
        assert abs(belief.x[0] + belief.x[-3] + 0.5) < 0.5  # it stands half a metre before the origin
        assert belief.P[0, 0] < 0.5 * start.P[0, 0]
        assert aid.share(belief.P[:2, LAYOUT.map_offset]) > 0.2
        assert belief.P[1, 1] == pytest.approx(start.P[1, 1], rel=0.05)  # nothing shown across
