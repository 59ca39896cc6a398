import math

import numpy as np
import pytest

from sim.operators.course import BEYOND_M, build_course, spread_starts
from sim.operators.routes import BRAKING_MPS2, LATERAL_MPS2, SPACING_M, Leg, Route, open_leg, speed_limits, tour

SQUARE = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0))
HOOK = ((0.0, 0.0), (40.0, 0.0), (50.0, 20.0), (50.0, 60.0))


def test_tour_is_even_closed_and_rounded() -> None:
    (lap,) = tour(SQUARE, 5.0).legs
    step = np.hypot(*np.diff(lap.points, axis=0, append=lap.points[:1]).T)
    np.testing.assert_allclose(step, lap.spacing_m, rtol=0.01)
    assert lap.spacing_m == pytest.approx(SPACING_M, rel=0.01)
    assert lap.length_m == pytest.approx(step.sum(), rel=1e-3)
    assert 1 / np.abs(lap.curvature()).max() == pytest.approx(0.886 * 5.0, rel=0.05)
    assert lap.curvature().sum() * lap.spacing_m == pytest.approx(2 * math.pi)


@pytest.mark.parametrize("leg", [*tour(SQUARE, 5.0).legs, open_leg(HOOK)], ids=["lap", "hook"])
def test_limits_are_of_the_bend_and_of_brakes_before_it(leg: Leg) -> None:
    limit, bend = speed_limits(leg, 6.0), np.sqrt(LATERAL_MPS2 / np.maximum(np.abs(leg.curvature()), 1e-6))
    following = np.roll(limit, -1) if leg.closed else np.append(limit[1:], limit[-1])
    braked = np.sqrt(following**2 + 2 * BRAKING_MPS2 * leg.spacing_m)
    np.testing.assert_allclose(limit, np.minimum(np.minimum(bend, 6.0), braked), atol=1e-9)
    assert limit.max() == 6.0 > limit.min()


def test_course_follows_laps_and_goes_straight_on_beyond_open_ends() -> None:
    lap, hook = tour(SQUARE), open_leg(HOOK)
    course = build_course([lap, Route((hook,))], [4.0, 2.0])
    legs = np.array([0, 1])
    start, direction = course.at(legs, np.zeros(2))
    np.testing.assert_allclose(start, [lap.legs[0].points[0], hook.points[0]])
    np.testing.assert_allclose(np.hypot(*direction.T), 1.0, rtol=0.02)
    ahead, _ = course.at(legs, course.length_m[legs] + 10.0)
    again, _ = course.at(legs, np.array([10.0, 0.0]))
    np.testing.assert_allclose(ahead[0], again[0], atol=1e-6)
    np.testing.assert_allclose(ahead[1], [50.0, 70.0], atol=0.01)
    assert course.limit(legs, np.full(2, 30.0)).max() == 4.0
    far, _ = course.at(legs, course.length_m[legs] + 10 * BEYOND_M)  # harmless, beyond any look-ahead
    assert np.isfinite(far).all()


@pytest.mark.slow
def test_machines_line_up_by_share_and_apart() -> None:
    routes = [tour(SQUARE)] * 4
    length = routes[0].length_m
    starts = spread_starts(routes, [0.0, 0.25, 0.25, 1.0])
    assert [round(s.distance_m / length, 2) for s in starts] == [0.0, 0.25, 0.25, 0.0]
    apart = spread_starts(routes, [0.0, 0.25, 0.25, 1.0], 12.0)
    joints = np.array([s.joint_m for s in apart])
    gaps = np.hypot(*(joints[:, None] - joints[None]).transpose(2, 0, 1)) + 1e3 * np.eye(4)
    assert 12.0 <= gaps.min() < 13.0
    with pytest.raises(ValueError, match="no room for 60 machines 12 m apart"):
        spread_starts([routes[0]] * 60, [0.0] * 60, 12.0)
