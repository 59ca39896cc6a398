"""Machines for pages: pose, track, status. Thread-safe."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from operator import itemgetter
from typing import Any

from protocol.errors import MessageError, Refusal
from protocol.wire.latest_values import LatestValues
from protocol.wire.messages import Health, Pose
from sitegrid.health import problems_of, report_of
from sitegrid.web.values import plain

MOST_POSES, TRACK_STEP_NS = 600, 10**9  # per track: ten minutes of site time
MOST_IN_ALL = 100 * MOST_POSES  # beyond it tracks get shorter
SILENT_S = 120.0  # machines silent for longer are omitted


@dataclass
class _Machine:
    pose: Pose | None = None
    pose_s: float = 0.0  # time of arrival
    track: deque[Pose] = field(default_factory=deque)
    health: Mapping[str, Any] = field(default_factory=dict)


class Machines:
    """A site's recently heard machines, at most MOST_NAMES. heard: number of poses."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._heard: LatestValues[_Machine] = LatestValues(clock)
        self._findings: Mapping[str, str] = {}
        self.heard = 0

    def __len__(self) -> int:
        return len(self._heard)

    def on_pose(self, pose: Pose) -> None:
        """Take a pose; MessageError if there are too many machines."""
        with self._lock:
            known = self._heard.get(pose.machine)
            machine = self._hear(pose.machine)
            machine.pose, machine.pose_s, track = pose, self._clock(), machine.track
            self.heard += 1
            if not track or abs(pose.stamp_ns - track[-1].stamp_ns) >= TRACK_STEP_NS:  # its clock may be set back
                track.append(pose)
            most = min(MOST_POSES, MOST_IN_ALL // len(self._heard))
            for each in [machine] if known else self._heard:
                while len(each.track) > most:
                    each.track.popleft()

    def on_health(self, health: Health) -> None:
        """Take a machine's health; MessageError as for a pose."""
        with self._lock:
            self._hear(health.machine).health = health.values

    def on_findings(self, findings: Mapping[str, str]) -> None:
        """Take the map server's findings, a sentence each."""
        with self._lock:
            self._findings = findings

    def poses(self) -> list[dict[str, Any]]:
        """Newest pose of each recent machine, its age, and faults."""
        with self._lock:
            now_s = self._clock()
            known = [(m.pose, now_s - m.pose_s, self._faults(name, m)) for name, m, _ in self._heard.items() if m.pose]
        return [
            plain({**asdict(pose), "age_s": round(age_s, 3), "faults": faults})
            for pose, age_s, faults in known
            if age_s < SILENT_S
        ]

    def reports(self) -> list[dict[str, Any]]:
        """Status of each recent machine, by name."""
        with self._lock:
            now_s = self._clock()
            known = [
                {
                    **report_of(m.health),
                    "machine": name,
                    "age_s": round(now_s - s, 1),
                    "problems": self._faults(name, m),
                }
                for name, m, s in self._heard.items()
                if m.health and now_s - s < SILENT_S
            ]
        return sorted(map(plain, known), key=itemgetter("machine"))

    def tracks(self) -> dict[str, list[Pose]]:
        """Track of each machine, oldest first."""
        with self._lock:
            return {name: list(machine.track) for name, machine, _ in self._heard.items() if machine.track}

    def _hear(self, name: str) -> _Machine:
        machine = self._heard.get(name) or _Machine()
        if not self._heard.hear(name, machine):
            raise MessageError(Refusal.OVERLOADED, f"{len(self._heard)} others spoke lately", field="machine")
        return machine

    def _faults(self, name: str, machine: _Machine) -> list[str]:
        return [*problems_of(machine.health), *filter(None, [self._findings.get(name)])]
