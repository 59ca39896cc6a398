"""The pure core of an agent: readings to samples. No clock, files or network.

`Positioning` locates the machine; `Pipeline` adds ground estimates and samples. The smoothed track has a node each
second. Between nodes the correction, smoothed less filtered, is interpolated: it changes slowly, and the filter's poses
hold the motion.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from agents.clock_offsets import ClockOffsets, Offset
from agents.estimation.calibration import EDGE_M, Calibration
from agents.estimation.ground import GroundEstimator
from agents.estimation.tuning import TUNING, EstimationTuning
from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from agents.localisation.filters.state import SPEED
from agents.localisation.lanes.aid import LaneAid
from agents.positioning import Accepted, PipelineConfig, Positioning, in_name_order
from agents.sampling import NOTHING, Odometer, Sampler, Samples, joined
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import FuelRate, Reading
from protocol.rotations import wrap_angle
from protocol.site.site_config import SiteConfig

KEPT_NS = 30_000_000_000  # a pose's nodes come some seconds after it at most
CLOCKS_S = 600.0  # motion in which clock offsets are searched
LOOK_NS = 60_000_000_000  # interval of these searches
_stamp = attrgetter("stamp_ns")


class Pipeline:
    """Localisation, ground estimation and sampling of one machine. positioning: locates it."""

    def __init__(
        self,
        site: SiteConfig,
        machine: MachineConfig,
        config: PipelineConfig,
        calibration: Calibration | None = None,
        tuning: EstimationTuning = TUNING,
    ) -> None:
        """Start, with the ground estimator's earlier `calibration`."""
        self._site, self._machine, self._tuning = site, in_name_order(machine), tuning
        self._config, self._smooths = config, config.localisation.smoothing_s > 0
        self.positioning = Positioning(site, machine, config)
        self._counters: Counter[str] = Counter()
        self._newest_ns = self._looked_ns = 0
        self._clocks, self._offsets = ClockOffsets(machine, site, CLOCKS_S), list[Offset]()
        self._start(calibration)

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the heading is known."""
        return self.positioning.pose

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, or None."""
        return self.positioning.pose_at(stamp_ns)

    def slow_error_m(self, receiver: str) -> Floats:
        """Estimated slow error of a receiver (2,), east and north [m]."""
        return self.positioning.slow_error_m(receiver)

    @property
    def pending(self) -> int:
        """Number of samples not final."""
        return self._sampler.pending

    def step(self, readings: Sequence[Reading]) -> Samples:
        """Process readings in stamp order; returns the samples they allow."""
        self._clocks.take(readings)
        return joined([made for reading in readings for made in self._take(self.positioning.accept(reading))])

    def settle(self) -> Samples:
        """Final samples of all known so far, as no reading may come for long."""
        rest = self._take(self.positioning.finish())
        proven = self._place(self.positioning.conclude())
        return joined([*rest, *proven, self._settle(self.positioning.remaining())])

    def finish(self) -> Samples:
        """The same at the end of the stream; what has no position is counted."""
        samples = self.settle()
        self._withhold_waiting()
        return samples

    @property
    def lanes(self) -> LaneAid | None:
        """Lanes of the shared map; None if unused."""
        return self.positioning.lanes

    def consider(self, offer: Any) -> None:
        """Judge a calibration offer of the map server."""
        self._estimator.consider(offer)

    @property
    def calibration(self) -> Calibration:
        """The ground estimator's current calibration."""
        return self._estimator.calibration

    def health(self) -> dict[str, Any]:
        """State of the stages in plain values."""
        pose, localiser = self.pose, self.positioning.localiser
        std_m = float(np.sqrt(np.linalg.eigvalsh(pose.covariance_m2)[-1])) if pose else None
        return {
            "aligned": localiser.is_aligned,
            "heading_proven": localiser.is_proven,
            "repeating": localiser.repeating,
            "wheel_scale": localiser.wheel_scale,
            "faults": self.faults,
            "position_std_m": std_m,
            "speed_mps": pose.speed_mps if pose else None,
            "counters": dict(self._counters + self.positioning.counters),
            "withheld": dict(self._sampler.withheld),
            "without_resistance": dict(self._sampler.without_resistance),
            "ground": self._estimator.health(),
            "consistency": {name: value.report for name, value in localiser.consistency.items()},
            "machine_share": localiser.machine_share,
        }

    @property
    def faults(self) -> dict[str, str]:
        """Sensor faults, a sentence by sensor."""
        return self.positioning.faults

    def clocks(self) -> str:
        """Sensors whose clocks differ, and what to do; or empty."""
        if abs(self._newest_ns - self._looked_ns) > LOOK_NS:
            self._looked_ns, self._offsets = self._newest_ns, self._clocks.find()
        refused = self._clocks.named({name: (ahead_s, 0.0) for name, ahead_s in self.positioning.clocks_s.items()})
        named = {offset.sensor for offset in refused}
        sentences = [offset.sentence(is_refused=True) for offset in refused]
        return "; ".join(sentences + [o.sentence() for o in self._offsets if o.sensor not in named])

    def _take(self, stamps: Iterable[Accepted]) -> list[Samples]:
        return [samples for accepted in stamps for samples in self._take_one(accepted)]

    def _take_one(self, accepted: Accepted) -> list[Samples]:
        readings, poses, smoothed, restarts, off_m, concluded = accepted
        self._track.append(smoothed, self._sampler.oldest_ns)
        made: list[Samples] = []
        if restarts:
            made += self._place(concluded)
            made.append(self._settle((), off_m))
            self._count_withheld()
            self._start(self._estimator.calibration)
        for pose in poses:
            self.positioning.poses.append(pose)
        if self.positioning.localiser.is_proven:
            made += self._place(poses)
        stamp_ns = readings[0][0].stamp_ns
        self._newest_ns = stamp_ns if restarts else max(self._newest_ns, stamp_ns)  # a clock may be set back
        dead_reckoning, belief = self.positioning.dead_reckoning, self.positioning.localiser.belief
        speed_mps, known_c_rr, newest = float(belief.x[SPEED]) if belief else None, self._known_c_rr(), self.pose
        if mass_kg := self._estimator.estimated_mass_kg:
            dead_reckoning.mass_kg = mass_kg
        for reading, sensor in readings:
            self._estimator.update(reading, sensor, dead_reckoning, known_c_rr, newest)
            if isinstance(reading, FuelRate):
                self._sampler.fuel.add(reading, dead_reckoning.motion(reading.stamp_ns).speed_mps)
        if (traction := self._estimator.traction) is not None:
            dead_reckoning.pull(traction)
        distance_m = self._odometer.update(stamp_ns, dead_reckoning.wheels_ns, dead_reckoning.distance_m, speed_mps)
        self._sampler.mark(stamp_ns, distance_m)
        made += self._due_samples()
        if smoothed and self._watch.is_clear:
            made.append(Samples(NOTHING, self._sampler.final_samples(self._corrected)))
        return made

    def _place(self, poses: Sequence[PoseBelief]) -> list[Samples]:
        """Samples by proven poses, one at a time: after a late alignment the history does not hold all."""
        made: list[Samples] = []
        for pose in poses:
            self._sampler.poses.append(pose)
            made += self._due_samples()
        return made

    def _due_samples(self) -> list[Samples]:
        rows = self._sampler.due_samples(self._newest_ns, self._estimator.at)
        if not len(rows):
            return []
        if self.lanes:
            self.lanes.feel(rows)
        return [Samples(rows, NOTHING if self._smooths else self._sampler.final_samples(lambda pose: pose))]

    def _settle(self, remaining: Sequence[SmoothedPose], off_m: float = 0.0) -> Samples:
        """All known samples. remaining: smoothed poses not final. off_m: possible error of places."""
        rows = self._sampler.due_samples(self._newest_ns, self._estimator.at, waits=False)

        def corrected(pose: PoseBelief) -> PoseBelief:
            known = self._track.corrected_by_now(pose, remaining)
            return less_sure(known, max(off_m, self._watch.off_m(pose.stamp_ns)))

        return Samples(rows, self._sampler.final_samples(corrected))

    def _corrected(self, pose: PoseBelief) -> PoseBelief | None:
        known = self._track.corrected(pose)
        return less_sure(known, self._watch.off_m(pose.stamp_ns)) if known else None

    def _withhold_waiting(self) -> None:
        unproven = self.pose is not None and self._sampler.poses.newest is None
        self._sampler.withheld["heading_unproven" if unproven else "no_pose"] += self._sampler.waiting

    def _count_withheld(self) -> None:
        self._withhold_waiting()
        self._counters.update({f"withheld_{reason}": n for reason, n in self._sampler.withheld.items()})

    def _known_c_rr(self) -> float | None:
        """Stated resistance of the ground here, if the position is certain enough."""
        areas = self._site.known_ground
        if not areas or not (pose := self.pose) or not self._watch.is_clear:
            return None
        std_m = float(np.sqrt(np.linalg.eigvalsh(pose.covariance_m2)[-1]))
        margin_m = EDGE_M + 2 * std_m
        return next((area.c_rr for area in areas if area.inside_m(pose.x_m, pose.y_m) > margin_m), None)

    def _start(self, known: Calibration | None) -> None:
        """Start with nothing but the calibration, as after power-up or a clock jump."""
        config, machine = self._config, self._machine
        self._estimator = GroundEstimator(machine, config.estimation, known, self._tuning)
        self._sampler, self._watch = Sampler(machine.load_centre_m), self.positioning.localiser.watch
        self._sampler.is_clear = lambda stamp_ns: not self._watch.off_m(stamp_ns)
        self._odometer = Odometer()
        self._track = SmoothedTrack()


PoseSource = Positioning | Pipeline  # what locates a machine


class SmoothedTrack:
    """Final nodes, oldest first."""

    def __init__(self) -> None:
        self._nodes: list[SmoothedPose] = []

    def append(self, nodes: Sequence[SmoothedPose], needed_ns: int | None = None) -> None:
        """Add newer nodes. needed_ns: of the oldest pose still needed."""
        if nodes and self._nodes:
            newest_ns = self._nodes[-1].stamp_ns
            oldest_ns = min(newest_ns, newest_ns if needed_ns is None else needed_ns) - KEPT_NS
            del self._nodes[: bisect_left(self._nodes, oldest_ns, key=_stamp)]
        self._nodes += nodes

    def corrected(self, pose: PoseBelief) -> PoseBelief | None:
        """The smoothed pose; None until the node after it is final."""
        known = self._nodes and pose.stamp_ns <= self._nodes[-1].stamp_ns
        return corrected(pose, self._nodes) if known else None

    def corrected_by_now(self, pose: PoseBelief, remaining: Sequence[SmoothedPose]) -> PoseBelief:
        """The pose as smoothed so far. remaining: nodes not final yet."""
        return corrected(pose, [*self._nodes, *remaining])


def less_sure(pose: PoseBelief, off_m: float) -> PoseBelief:
    """The pose with a possible further error."""
    return replace(pose, covariance_m2=pose.covariance_m2 + off_m**2 * np.eye(2)) if off_m else pose


def corrected(pose: PoseBelief, nodes: Sequence[SmoothedPose]) -> PoseBelief:
    """The pose moved by the interpolated correction, with the smoothed covariance.

    nodes: oldest first; beyond them the nearest holds, without any the pose stays.
    """
    if not nodes:
        return pose
    i = bisect_left(nodes, pose.stamp_ns, key=_stamp)
    after, before = nodes[min(i, len(nodes) - 1)], nodes[max(i - 1, 0)]
    span_ns = after.stamp_ns - before.stamp_ns
    share = (pose.stamp_ns - before.stamp_ns) / span_ns if span_ns else 1.0
    dx, dy, turn = (before.correction + share * (after.correction - before.correction)).tolist()
    covariance_m2 = before.covariance_m2 + share * (after.covariance_m2 - before.covariance_m2)
    aided = before.aid_share + share * (after.aid_share - before.aid_share)
    heading_rad = wrap_angle(pose.heading_rad + turn)
    return PoseBelief(pose.stamp_ns, pose.x_m + dx, pose.y_m + dy, heading_rad, pose.speed_mps, covariance_m2, aided)
