"""Live positions of all machines of a site, collected for pictures and reports."""

from __future__ import annotations

import threading

import numpy as np
import zenoh

from mapserver.pictures.plotter import Track
from protocol.errors import MessageError
from protocol.wire import keys
from protocol.wire.codec import decode_pose
from protocol.wire.messages import Pose

MAX_POSES = 50_000  # of one machine: nearly three hours at 5 Hz


class TrackRecorder:
    """Subscribes to the poses of a site."""

    def __init__(self, session: zenoh.Session, site: str) -> None:
        self._lock = threading.Lock()
        self._poses: dict[str, list[Pose]] = {}
        self._subscriber = session.declare_subscriber(keys.poses_all(site), self._on_pose)

    def poses(self) -> dict[str, list[Pose]]:
        """All poses so far, by machine."""
        with self._lock:
            return {name: list(poses) for name, poses in sorted(self._poses.items())}

    def tracks(self) -> list[Track]:
        """All poses so far, as lines to draw."""
        return [
            Track(name, np.array([p.x_m for p in poses]), np.array([p.y_m for p in poses]))
            for name, poses in self.poses().items()
        ]

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_pose(self, sample: zenoh.Sample) -> None:
        try:
            pose = decode_pose(sample.payload.to_bytes())
        except MessageError:  # a pose that cannot be read is not drawn
            return
        with self._lock:
            poses = self._poses.setdefault(pose.machine, [])
            poses.append(pose)
            if len(poses) > MAX_POSES:
                del poses[: MAX_POSES // 10]
