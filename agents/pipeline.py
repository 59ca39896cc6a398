"""The machine's pure heart: readings in, samples out. No clock, no files, no network."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from agents.estimation.calibration import Calibration
from agents.estimation.ground import EstimationConfig, GroundEstimator
from agents.localisation.belief import PoseBelief
from agents.localisation.localiser import LocalisationConfig, Localiser
from agents.localisation.state import SPEED
from agents.order import Order, Verdict
from agents.sampling import NOTHING, Sampler, SamplingConfig, Way
from protocol.arrays import Table
from protocol.machine import MachineConfig
from protocol.readings import Reading
from protocol.site import Projection, SiteConfig


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


class Pipeline:
    """Localisation, ground estimation and sampling of one machine."""

    def __init__(
        self, site: SiteConfig, machine: MachineConfig, config: PipelineConfig, calibration: Calibration | None = None
    ) -> None:
        """calibration: of the ground estimator, from before."""
        self._site, self._machine = site, machine
        self._config = config
        self._projection = Projection(site)
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        self._order = Order(config.gap_s, config.late_s)
        self._counters: Counter[str] = Counter()
        self._newest_ns = 0
        self._start(calibration)

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the start heading is known."""
        return self._sampler.poses.newest

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, None where it is not known."""
        return self._sampler.poses.at(stamp_ns)

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
        pose = self.pose
        std_m = float(np.sqrt(np.linalg.eigvalsh(pose.covariance_m2)[-1])) if pose else None
        return {
            "aligned": self._localiser.is_aligned,
            "position_std_m": std_m,
            "counters": dict(self._counters + self._order.counters + self._localiser.counters),
            "withheld": dict(self._sampler.withheld),
            "without_resistance": dict(self._sampler.without_resistance),
            "ground": self._estimator.health(),
            "consistency": {
                name: {**asdict(found), "good": found.is_good} for name, found in self._localiser.consistency.items()
            },
        }

    def _step_one(self, reading: Reading) -> list[Table]:
        sensor = self._sensors.get(reading.sensor)
        if sensor is None or sensor.kind != reading.kind:
            self._counters["reading_unknown_sensor"] += 1
            return []
        if sensor.delay_s:
            reading = replace(reading, stamp_ns=reading.stamp_ns - round(sensor.delay_s * 1e9))
        verdict = self._order.judge(reading)
        if verdict is Verdict.REFUSE:
            return []
        made: list[Table] = []
        if verdict is Verdict.RESTART:
            made.append(self.finish())
            self._counters.update(self._localiser.counters)
            self._counters.update({f"withheld_{reason}": n for reason, n in self._sampler.withheld.items()})
            self._start(self._estimator.calibration)
        for pose in self._localiser.update(reading, sensor):  # after a late alignment more than the history holds
            self._sampler.poses.append(pose)
            made.append(self._take())
        self._newest_ns = max(self._newest_ns, reading.stamp_ns)
        dead = self._localiser.dead
        self._estimator.update(reading, sensor, dead, self._known_c_rr())
        belief = self._localiser.belief
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
        margin_m = self._config.estimation.calibration.edge_m + 2 * std_m
        return next((area.c_rr for area in areas if area.inside_m(pose.x_m, pose.y_m) > margin_m), None)

    def _start(self, known: Calibration | None) -> None:
        """Start with nothing known but the calibration, as after power-up or a jump of the clock."""
        config, machine = self._config, self._machine
        self._localiser = Localiser(machine, self._projection, config.localisation)
        self._estimator = GroundEstimator(machine, config.estimation, known)
        self._sampler = Sampler(machine.load_centre_m, config.sampling)
        self._way = Way()
