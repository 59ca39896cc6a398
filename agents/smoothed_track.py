"""The smoothed track: where the machine was, as known a while later; it corrects what the filter believed at once.

The smoother has a node in every second. Between two of them the correction, smoothed less filtered, is interpolated:
it changes slowly, while the filter's own poses have all that the machine did meanwhile.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from operator import attrgetter

from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from protocol.rotations import wrap_angle

KEPT_NS = 30_000_000_000  # a pose is corrected as soon as its nodes are there; it comes at most some seconds after them
_stamp = attrgetter("stamp_ns")


class SmoothedTrack:
    """Nodes that are final, oldest first."""

    def __init__(self) -> None:
        self._nodes: list[SmoothedPose] = []

    def append(self, nodes: Sequence[SmoothedPose]) -> None:
        """Add nodes, which are newer than those before."""
        if nodes and self._nodes:
            del self._nodes[: bisect_left(self._nodes, self._nodes[-1].stamp_ns - KEPT_NS, key=_stamp)]
        self._nodes += nodes

    def corrected(self, pose: PoseBelief) -> PoseBelief | None:
        """The pose as smoothed; None while the node after it is not final."""
        known = self._nodes and pose.stamp_ns <= self._nodes[-1].stamp_ns
        return corrected(pose, self._nodes) if known else None

    def corrected_by_now(self, pose: PoseBelief, remaining: Sequence[SmoothedPose]) -> PoseBelief:
        """The pose as smoothed by what is known now. remaining: nodes that are not final, after those that are."""
        return corrected(pose, [*self._nodes, *remaining])


def corrected(pose: PoseBelief, nodes: Sequence[SmoothedPose]) -> PoseBelief:
    """The filter's pose, moved and turned by the correction at its stamp, with the smoothed covariance.

    nodes: oldest first; beyond them the nearest one holds, without any the pose stays as it is.
    """
    if not nodes:
        return pose
    i = bisect_left(nodes, pose.stamp_ns, key=_stamp)
    after, before = nodes[min(i, len(nodes) - 1)], nodes[max(i - 1, 0)]
    span_ns = after.stamp_ns - before.stamp_ns
    share = (pose.stamp_ns - before.stamp_ns) / span_ns if span_ns else 1.0
    dx, dy, turn = (before.correction + share * (after.correction - before.correction)).tolist()
    covariance_m2 = before.covariance_m2 + share * (after.covariance_m2 - before.covariance_m2)
    heading_rad = wrap_angle(pose.heading_rad + turn)
    return PoseBelief(pose.stamp_ns, pose.x_m + dx, pose.y_m + dy, heading_rad, pose.speed_mps, covariance_m2)
