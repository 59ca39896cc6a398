"""Laws of lanes: no information without lanes, valid covariances, no place used twice, visible map shifts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose
from agents.localisation.filters.belief import FREED, Belief, Measurement, Motion, extended, freed
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import BESIDE_STD_M, MotionModel
from agents.localisation.filters.smoother import nothing_past
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.filters.ukf import Ukf
from agents.localisation.lanes.aid import LANES, LaneAid
from agents.localisation.lanes.guards import AFTER_NS, OFF_NS, Guards, prior_m2, share_of, shown
from agents.localisation.lanes.lane_map import LaneMap
from agents.localisation.lanes.matching import FAR_SIGMA, Match, match
from agents.localisation.lanes.window import WINDOW_M, Window
from protocol.queries.lanes import SCALE_M, SLOPES, UNKNOWN_SLOPE, LaneTile

LAYOUT = Layout(imus=1, lanes=True)
NO_SLOPES = np.full(SLOPES, UNKNOWN_SLOPE, np.int8)
SQUARE = [(0.0, 0.0, 0.0), (40.0, 0.0, math.pi / 2), (40.0, 40.0, math.pi), (0.0, 40.0, -math.pi / 2)]


def lane_map(metres):
    """Lanes around the origin, 8 x 8 squares; metres (16, rows, columns)."""
    planes = SCALE_M.quantised(np.where(metres > 0, metres, np.nan))
    tiles = {
        (x, y): LaneTile(
            x, y, 1, 9, 2, 3, planes[:, 16 * y + 64 :, 16 * x + 64 :][:, :16, :16].reshape(16, 256), NO_SLOPES
        )
        for x in range(-4, 4)
        for y in range(-4, 4)
    }
    return LaneMap(1.0, tiles)


def flat(value=5.0):
    return lane_map(np.full((16, 128, 128), value))


def lane_north(column):
    """A northward lane, two cells wide, centred on a column's west edge."""
    metres = np.zeros((16, 128, 128))
    metres[4, :, column + 63 : column + 65] = 10.0
    return lane_map(metres)


def straight(count=20):
    """The way back along a straight northward drive."""
    return np.stack([np.zeros(count), -np.arange(count, dtype=float)], axis=1), np.full(count, math.pi / 2)


def belief_at(x_m=0.0, stamp_ns=0, states=LAYOUT):
    x = np.zeros(states.n)
    x[0], x[YAW] = x_m, math.pi / 2
    P = np.diag(np.full(states.n, 0.01))
    P[:2, :2] = [[1.5, 0.3], [0.3, 1.0]]
    P[-3:, -3:] = np.diag(prior_m2(young=False))
    return Belief(stamp_ns, x, P, past=nothing_past(states.n, 90.0))


def test_ground_without_lanes_tells_nothing():
    back_m, heading = straight()
    for lanes in (flat(), LaneMap(1.0), flat(50.0)):
        assert match(lanes, np.zeros(2), np.diag([4.0, 9.0]), back_m, heading) == "flat"


@pytest.mark.parametrize("off_m", [-3.0, -1.0, 0.0, 2.0])
def test_a_lane_shows_how_far_beside_it_the_machine_seems_to_be(off_m):
    back_m, heading = straight()
    matched = match(lane_north(0), np.array([off_m, 0.0]), np.diag([4.0, 4.0]), back_m, heading)
    assert isinstance(matched, Match)
    assert matched.place_m[0] == pytest.approx(0.0, abs=0.25)
    assert 1.0 < matched.covariance_m2[0, 0] < 2.0
    assert matched.covariance_m2[1, 1] > 1000  # nothing observable along a straight


@pytest.mark.parametrize("begins_m", [-12, -8, -4, 0])
@pytest.mark.parametrize("P", [np.diag([4.0, 4.0]), np.array([[4.0, 1.0], [1.0, 3.0]])])
def test_a_window_moves_the_place_by_no_more_than_it_tells(begins_m, P):
    """Where lanes begin likelihood rises steadily: that moves the mean, and hardly narrows it."""
    metres = np.zeros((16, 128, 128))
    metres[4, 64 + begins_m :, 63:65] = 10.0
    for off_m in (0.0, 2.0):
        place_m = np.array([off_m, 0.0])
        matched = match(lane_map(metres), place_m, P, *straight())
        assert isinstance(matched, Match)
        y = matched.place_m - place_m
        assert y @ np.linalg.solve(P + matched.covariance_m2, y) < 2 * FAR_SIGMA**2


def test_lanes_that_one_machine_drew_today_are_left_out():
    tiles, day_ns = lane_north(0).tiles, 86_400 * 10**9
    for days, machines, newest_ns, kept in ((1, 1, 1, 0), (1, 2, 1, 64), (2, 1, 1, 64), (1, 1, -day_ns, 64)):
        drawn = {at: replace(t, days=days, machines=machines, newest_ns=newest_ns) for at, t in tiles.items()}
        assert len(LaneMap(1.0, drawn).of_others(2).tiles) == kept


def test_lanes_of_another_direction_tell_nothing():
    back_m, heading = straight()
    assert match(lane_north(0), np.zeros(2), np.diag([4.0, 4.0]), back_m, heading + math.pi / 2) == "flat"


def test_every_place_is_in_one_window():
    window, seen, ends = Window(2.0), [], 0
    for step in range(2000):
        angle = 0.01 * step
        at = DeadReckonedPose(step * 10**8, 0.0, angle, 20 * math.cos(angle), 20 * math.sin(angle))
        if window.add(at):
            back_m, heading = window.end(angle)
            seen += [tuple(place) for place in np.round(back_m + np.array([at.x_m, at.y_m]), 6)]
            assert len(heading) == len(back_m) <= WINDOW_M + 1
            ends += 1
    assert ends == 19  # chords of 400 m of arc are slightly shorter
    assert len(set(seen)) == len(seen)


@pytest.mark.parametrize("engine", [Ekf(), Ukf()])
@pytest.mark.parametrize("tells", [False, True])
def test_a_thousand_windows(engine, tells):
    """Flat ground changes no bit; lanes leave a covariance and the same place."""
    aid, model = LaneAid(0.0), MotionModel(LAYOUT)
    aid.lanes = lane_north(0) if tells else flat()
    start = belief_at(stamp_ns=10**9)
    fusion = Fusion(engine, model, start)
    for step in range(1000):
        for place in range(22):
            aid.is_due(DeadReckonedPose(10**9 + step, 0.0, 0.0, step * 20.0 + place, 0.0))
        belief = fusion.belief
        measurement = aid.measurement(Belief(belief.stamp_ns + AFTER_NS * bool(step), belief.x, belief.P))
        if measurement:
            conditioned = engine.condition(belief, measurement)
            assert conditioned.accepted
            fusion = Fusion(engine, model, conditioned.belief)
            assert np.linalg.eigvalsh(conditioned.belief.P)[0] > 0
    if not tells:
        assert fusion.belief is start
        assert aid.counters == {f"{LANES}_flat": 999}
    assert np.abs(fusion.belief.x - start.x).max() < 0.2


def test_states_that_come_later_leave_the_others_as_they_are():
    small = Layout(imus=1)
    belief = belief_at(states=Layout(imus=1, lanes=True))
    bare = Belief(0, belief.x[: small.n], belief.P[: small.n, : small.n], past=nothing_past(small.n, 90.0))
    fusion = Fusion(Ukf(), MotionModel(small), bare)
    fusion.extend(MotionModel(LAYOUT), prior_m2(young=True))
    moved, alone = fusion.at(2 * 10**9), Fusion(Ukf(), MotionModel(small), bare).at(2 * 10**9)
    assert np.allclose(moved.x[: small.n], alone.x, atol=1e-12)
    assert np.allclose(moved.P[: small.n, : small.n], alone.P, atol=1e-12)
    assert moved.P[LAYOUT.beside_lane, LAYOUT.beside_lane][0, 0] == pytest.approx(BESIDE_STD_M**2)
    assert not moved.P[: small.n, small.n :].any()
    assert extended(bare, prior_m2(young=False)).past is not None


@pytest.mark.parametrize("engine", [Ekf(), Ukf()])
def test_the_share_of_lanes_is_how_far_places_go_with_the_map(engine):
    """Live and smoothed places, the map shifted east or north by 1 cm."""

    def driven(moved_m):
        fusion = Fusion(engine, MotionModel(LAYOUT), belief_at())
        for second in range(1, 40):
            place, rest = shown(LAYOUT.n, math.pi / 2), np.eye(LAYOUT.n)[3:15]
            place[:, -3:] *= second % 3 > 0  # every third is a fix
            z, variance = (moved_m, 1.0) if second % 3 else (np.zeros(2), 4.0)
            still = np.where(np.arange(12) == 2, math.pi / 2, 0.0)
            shown_now = (("place", place, z, np.eye(2) * variance), ("rest", rest, still, np.eye(12) * 1e-4))
            stamp_ns = second * 10**9
            fusion.add(
                [Measurement(n, stamp_ns, z, R, lambda x, H=H: x @ H.T, lambda _, H=H: H) for n, H, z, R in shown_now]
            )
        places = [(pose.x_m, pose.y_m) for pose in fusion.remaining()]
        return np.array(places), [share_of(pose.cross[:2, -3:-1], 1.0) for pose in fusion.remaining()]

    still, shares = driven(np.zeros(2))
    went = [(driven(0.01 * axis)[0] - still) / 0.01 for axis in np.eye(2)]
    assert 0.05 < min(shares) < max(shares) < 0.9
    np.testing.assert_allclose(np.linalg.norm(np.stack(went, axis=2), 2, axis=(1, 2)), shares, atol=2e-3)


@pytest.mark.parametrize("engine", [Ekf(), Ukf()])
def test_after_an_alarm_places_are_as_if_next_to_nothing_had_been_assumed_of_the_map(engine):
    """Live, and of each place of the past: what lanes 3 m elsewhere said of the place is taken back."""
    aid, n = LaneAid(0.0), LAYOUT.n

    def driven(times):
        """As the guards were assumed, or so many times as wide."""
        belief = belief_at()
        belief.P[-3:, -3:] *= times
        for second in range(1, 30):
            stays = Motion(lambda x: x, lambda _: np.eye(n), np.diag(np.r_[np.full(n - 3, 1e-3), np.zeros(3)]), ())
            belief = engine.predict(belief, stays, second * 10**9)
            H = shown(n, 0.1 * second)
            if second % 10 == 0:
                H[:, -3:] = 0.0  # a fix
            z = np.zeros(2) if second % 10 == 0 else np.array([3.0, 1.0])
            seen = Measurement("place", belief.stamp_ns, z, np.eye(2), lambda x, H=H: x @ H.T, lambda _, H=H: H)
            belief = engine.condition(belief, seen).belief
        return belief

    def places(belief):
        poses = belief.past.poses(belief.stamp_ns, belief.x, belief.P)
        return [(*(pose.x_m, pose.y_m), *pose.covariance_m2.ravel(), *pose.cross.ravel()) for pose in poses]

    assumed, wide = driven(1.0), driven(FREED)
    assert aid.share(assumed.P[:2, LAYOUT.map_offset]) > 0.2
    assert abs(places(assumed)[-1][0] - places(wide)[-1][0]) > 0.2
    undone = freed(assumed, LAYOUT.lane_guards, prior_m2(young=False))
    np.testing.assert_allclose(undone.x, wide.x, atol=1e-6)
    np.testing.assert_allclose(undone.P, wide.P, atol=1e-6)
    np.testing.assert_allclose(places(undone), places(wide), atol=1e-6)

    assert not aid.judge(Belief(assumed.stamp_ns, assumed.x + 2.1 * np.eye(n)[-3], assumed.P), 1.0, LAYOUT)
    taken = aid.taken_back(assumed, LAYOUT)
    np.testing.assert_array_equal(taken.x[:-3], undone.x[:-3])
    np.testing.assert_array_equal(taken.P[-3:, -3:], np.diag(prior_m2(young=False)))
    assert aid.share(taken.P[:2, LAYOUT.map_offset]) == 0.0


def test_alarms_turn_lanes_off_for_a_while():
    for mean, nis, why in (
        ([2.1, 0.0, 0.0], 1.0, "map_moved"),
        ([0.0, 0.0, -4.1], 1.0, "beside_lanes"),
        ([0.0, 0.0, 0.0], 30.0, "contradicted"),
    ):
        guards = Guards()
        assert not guards.is_open(1)
        assert guards.is_open(1 + AFTER_NS)
        alarms = [guards.judge(2 + AFTER_NS, np.array(mean), prior_m2(young=False), nis) for _ in range(8)]
        assert alarms[-1] == guards.alarm == why
        assert not guards.is_open(1 + AFTER_NS + OFF_NS)
        assert guards.is_open(2 + AFTER_NS + OFF_NS)
        assert guards.alarm == ""
