import math

import numpy as np
import pytest

from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from agents.pipeline import KEPT_NS, SmoothedTrack

S = 10**9


def node(seconds: float, correction: tuple[float, float, float], variance_m2: float = 0.5) -> SmoothedPose:
    return SmoothedPose(
        round(seconds * S), 0.0, 0.0, 0.0, np.diag([variance_m2, 2 * variance_m2]), np.array(correction)
    )


def pose(seconds: float, heading_rad: float = 0.0) -> PoseBelief:
    return PoseBelief(round(seconds * S), 10.0, 20.0, heading_rad, 3.0, np.diag([4.0, 8.0]))


def track(*nodes: SmoothedPose) -> SmoothedTrack:
    track = SmoothedTrack()
    track.append(nodes)
    return track


def test_correction_is_interpolated_between_nodes_and_the_covariance_is_the_smoothed_one() -> None:
    smoothed = track(node(1, (1.0, -2.0, 0.1), 0.5), node(2, (3.0, 0.0, 0.3), 1.5)).corrected(pose(1.25))
    assert (smoothed.x_m, smoothed.y_m, smoothed.heading_rad) == pytest.approx((11.5, 18.5, 0.15))
    assert smoothed.covariance_m2 == pytest.approx(np.diag([0.75, 1.5]))
    assert (smoothed.stamp_ns, smoothed.speed_mps) == (1_250_000_000, 3.0)


@pytest.mark.parametrize("seconds", [1, 2])
def test_at_a_node_its_own_correction_holds(seconds: int) -> None:
    nodes = {1: node(1, (1.0, 0.0, 0.0)), 2: node(2, (2.0, 0.0, 0.0), 0.7)}
    smoothed = track(*nodes.values()).corrected(pose(seconds))
    assert smoothed.x_m == 10.0 + seconds
    assert smoothed.covariance_m2 == pytest.approx(nodes[seconds].covariance_m2)


def test_a_pose_waits_for_the_node_after_it() -> None:
    some = track(node(1, (1.0, 0.0, 0.0)))
    assert some.corrected(pose(1.01)) is None
    assert track().corrected(pose(0)) is None
    assert some.corrected(pose(0.5)).x_m == 11.0, "what came before the first node is corrected as that"
    some.append([node(2, (2.0, 0.0, 0.0))])
    assert some.corrected(pose(1.01)).x_m == pytest.approx(11.01)


def test_by_what_is_known_now_no_pose_waits() -> None:
    some, remaining = track(node(1, (1.0, 0.0, 0.0))), [node(2, (2.0, 0.0, 0.0))]
    assert some.corrected_by_now(pose(1.5), remaining).x_m == pytest.approx(11.5)
    assert some.corrected_by_now(pose(9), remaining).x_m == pytest.approx(12.0)
    assert some.corrected(pose(1.5)) is None, "what remains is not final"
    unknown = pose(5)
    assert SmoothedTrack().corrected_by_now(unknown, ()) is unknown


def test_heading_turns_across_the_back() -> None:
    smoothed = track(node(1, (0.0, 0.0, 0.2)), node(2, (0.0, 0.0, 0.2))).corrected(pose(1.5, math.pi - 0.1))
    assert smoothed.heading_rad == pytest.approx(0.1 - math.pi)


def test_a_machine_that_stands_for_a_week_keeps_some_nodes_only() -> None:
    some = SmoothedTrack()
    for second in range(1000):
        some.append([node(second, (float(second), 0.0, 0.0))])
    assert len(some._nodes) <= KEPT_NS // S + 2
    assert some.corrected(pose(999 - KEPT_NS // S)).x_m == pytest.approx(10 + 999 - KEPT_NS // S)


def test_nodes_that_come_all_at_once_are_kept_until_their_poses_were_corrected() -> None:
    """After a late alignment: minutes of nodes and of samples in one step."""
    some = track(*(node(second, (float(second), 0.0, 0.0)) for second in range(600)))
    assert some.corrected(pose(3.5)).x_m == pytest.approx(13.5)
