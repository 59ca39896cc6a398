"""The machine's pure heart: readings in, samples out. No clock, no files, no network.

`Positioning` is the half of it that says where the machine is; `Pipeline` adds the ground there, and samples of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from agents.drivers.stream_order import Order, Verdict
from agents.estimation.calibration import EDGE_M, Calibration
from agents.estimation.ground import EstimationConfig, GroundEstimator
from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.state import SPEED
from agents.localisation.localiser import LocalisationConfig, Localiser
from agents.sampling import NOTHING, PoseHistory, Sampler, SamplingConfig, Way
from protocol.arrays import Table
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection, SiteConfig


@dataclass(frozen=True)
class PipelineConfig:
    """Options of the pure core, one table per stage.

    gap_s: a pause in the readings longer than this starts localisation anew. late_s: readings that come later than
    this behind the newest are refused.
    """

    gap_s: float = 5.0
    late_s: float = 0.5
    localisation: LocalisationConfig = field(default_factory=LocalisationConfig)
    estimation: EstimationConfig = field(default_factory=EstimationConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)

    def __post_init__(self) -> None:
        if self.gap_s <= 0 or self.late_s < 0:
            raise ValueError("gap_s must be positive and late_s not negative")


class Locates(Protocol):
    """What finds out where a machine is: a `Pipeline`, or its half that does nothing else."""

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the start heading is known."""
        ...

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, None where it is not known."""
        ...

    def step(self, readings: Sequence[Reading]) -> object:
        """Take in readings in the order of their stamps."""
        ...


class Taken(NamedTuple):
    """A reading that counts, at the stamp of what it measured; a tuple, as there are hundreds a second.

    poses: what it made possible or changed, oldest first. restarts: nothing before it counts any more.
    """

    reading: Reading
    sensor: SensorConfig
    poses: list[PoseBelief]
    restarts: bool


class Positioning:
    """Localisation of one machine: readings are judged by their order, and recent poses remembered."""

    def __init__(self, site: SiteConfig, machine: MachineConfig, config: PipelineConfig) -> None:
        self._machine, self._config = machine, config
        self._projection = Projection(site)
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        self._order = Order(config.gap_s, config.late_s)
        self._counters: Counter[str] = Counter()
        self._start()

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the start heading is known."""
        return self._poses.newest

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, None where it is not known."""
        return self._poses.at(stamp_ns)

    @property
    def counters(self) -> Counter[str]:
        """What was used and refused, before restarts too."""
        return self._counters + self._order.counters + self.localiser.counters

    def step(self, readings: Sequence[Reading]) -> None:
        """Take in readings in the order of their stamps."""
        for reading in readings:
            self.take(reading)

    def take(self, reading: Reading) -> Taken | None:
        """Take in one reading; None where it is refused."""
        sensor = self._sensors.get(reading.sensor)
        if sensor is None or sensor.kind != reading.kind:
            self._counters["reading_unknown_sensor"] += 1
            return None
        if sensor.delay_s:
            reading = replace(reading, stamp_ns=reading.stamp_ns - round(sensor.delay_s * 1e9))
        verdict = self._order.judge(reading)
        if verdict is Verdict.REFUSE:
            return None
        if verdict is Verdict.RESTART:
            self._counters.update(self.localiser.counters)
            self._start()
        poses = self.localiser.update(reading, sensor)
        for pose in poses:
            self._poses.append(pose)
        return Taken(reading, sensor, poses, verdict is Verdict.RESTART)

    def _start(self) -> None:
        """Start with nothing known, as after power-up or a jump of the clock."""
        self.localiser = Localiser(self._machine, self._projection, self._config.localisation)
        self._poses = PoseHistory(self._config.sampling.history_s)


class Pipeline:
    """Localisation, ground estimation and sampling of one machine."""

    def __init__(
        self, site: SiteConfig, machine: MachineConfig, config: PipelineConfig, calibration: Calibration | None = None
    ) -> None:
        """calibration: of the ground estimator, from before."""
        self._site, self._machine = site, machine
        self._config = config
        self._positioning = Positioning(site, machine, config)
        self._counters: Counter[str] = Counter()
        self._newest_ns = 0
        self._start(calibration)

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the start heading is known."""
        return self._positioning.pose

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, None where it is not known."""
        return self._positioning.pose_at(stamp_ns)

    def step(self, readings: Sequence[Reading]) -> Table:
        """Take in readings in the order of their stamps; returns the samples (n,) that they made possible."""
        made = [rows for reading in readings for rows in self._step_one(reading) if len(rows)]
        return np.concatenate(made) if made else NOTHING

    def finish(self) -> Table:
        """Samples (n,) of what still waits, as the stream ends."""
        rows = self._sampler.take(self._newest_ns, self._estimator.at, waits=False)
        self._sampler.withheld["no_pose"] += self._sampler.waiting
        return rows

    @property
    def calibration(self) -> Calibration:
        """What the ground estimator found out about the machine's sensors."""
        return self._estimator.calibration

    def health(self) -> dict[str, Any]:
        """State of the stages in plain values."""
        pose, localiser = self.pose, self._positioning.localiser
        std_m = float(np.sqrt(np.linalg.eigvalsh(pose.covariance_m2)[-1])) if pose else None
        return {
            "aligned": localiser.is_aligned,
            "position_std_m": std_m,
            "counters": dict(self._counters + self._positioning.counters),
            "withheld": dict(self._sampler.withheld),
            "without_resistance": dict(self._sampler.without_resistance),
            "ground": self._estimator.health(),
            "consistency": {
                name: {**asdict(found), "good": found.is_good} for name, found in localiser.consistency.items()
            },
        }

    def _step_one(self, reading: Reading) -> list[Table]:
        taken = self._positioning.take(reading)
        if taken is None:
            return []
        reading, sensor, poses, restarts = taken
        made: list[Table] = []
        if restarts:
            made.append(self.finish())
            self._counters.update({f"withheld_{reason}": n for reason, n in self._sampler.withheld.items()})
            self._start(self._estimator.calibration)
        for pose in poses:  # after a late alignment more than the history holds
            self._sampler.poses.append(pose)
            made.append(self._take())
        self._newest_ns = max(self._newest_ns, reading.stamp_ns)
        localiser = self._positioning.localiser
        dead, belief = localiser.dead, localiser.belief
        self._estimator.update(reading, sensor, dead, self._known_c_rr())
        way_m = self._way.update(reading, dead.way_m, float(belief.x[SPEED]) if belief else 0.0)
        if self._sampler.is_due(way_m):
            self._sampler.mark(reading.stamp_ns, way_m)
        return [*made, self._take()]

    def _take(self) -> Table:
        return self._sampler.take(self._newest_ns, self._estimator.at)

    def _known_c_rr(self) -> float | None:
        """Resistance of the ground here, where the site says it and the position is sure enough."""
        pose, areas = self.pose, self._site.known_ground
        if not areas or not pose:
            return None
        std_m = float(np.sqrt(np.linalg.eigvalsh(pose.covariance_m2)[-1]))
        margin_m = EDGE_M + 2 * std_m
        return next((area.c_rr for area in areas if area.inside_m(pose.x_m, pose.y_m) > margin_m), None)

    def _start(self, known: Calibration | None) -> None:
        """Start with nothing known but the calibration, as after power-up or a jump of the clock."""
        config, machine = self._config, self._machine
        self._estimator = GroundEstimator(machine, config.estimation, known)
        self._sampler = Sampler(machine.load_centre_m, config.sampling)
        self._way = Way()
