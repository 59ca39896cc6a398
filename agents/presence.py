"""What others see of a machine: live pose, health, and a liveliness token."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import zenoh

from agents.localisation.belief import PoseBelief
from protocol import keys
from protocol.codec import encode_health, encode_pose
from protocol.messages import Health, Pose

POSE_NS = 200_000_000  # five a second, of the machine's own time


class Presence:
    """Publishes pose and health; both may be dropped on the way, the next one replaces them."""

    def __init__(self, session: zenoh.Session, site: str, machine: str) -> None:
        self._machine = machine
        drop = zenoh.CongestionControl.DROP
        self._pose = session.declare_publisher(keys.pose(site, machine), congestion_control=drop)
        self._health = session.declare_publisher(keys.health(site, machine), congestion_control=drop)
        self._token = session.liveliness().declare_token(keys.alive(site, machine))
        self._pose_ns = 0

    def show_pose(self, belief: PoseBelief) -> None:
        """Publish the pose if the last one is old enough."""
        if abs(belief.stamp_ns - self._pose_ns) < POSE_NS:
            return
        self._pose_ns = belief.stamp_ns
        (xx, xy), (_, yy) = belief.covariance_m2
        place = (belief.stamp_ns, belief.x_m, belief.y_m, belief.heading_rad, belief.speed_mps)
        self._pose.put(encode_pose(Pose(self._machine, *place, float(xx), float(xy), float(yy))))

    def show_health(self, stamp_ns: int, values: Mapping[str, Any]) -> None:
        """Publish a health report."""
        self._health.put(encode_health(Health(self._machine, stamp_ns, values)))

    def close(self) -> None:
        """Leave."""
        for entity in (self._token, self._pose, self._health):
            entity.undeclare()  # type: ignore[no-untyped-call]
