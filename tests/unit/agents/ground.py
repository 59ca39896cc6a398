"""Balances, steps and estimates for tests of ground estimation."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from agents.dead_reckoning import DeadReckoning
from agents.estimation.balance import Balance, Balancer, BalanceStep
from agents.estimation.calibration import Calibration
from agents.estimation.ground import EstimationConfig, GroundEstimate, GroundEstimator
from agents.estimation.resistance_kalman import KalmanResistance
from agents.estimation.resistance_rls import RecursiveResistance
from agents.estimation.tuning import TUNING, EstimationTuning
from agents.localisation.filters.belief import PoseBelief
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Reading
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS

STEP_S = 0.05

# A loader at 2 m/s on level ground, c_rr 0.04.
STEADY = Balance(
    stamp_ns=START_NS,
    dt_s=STEP_S,
    speed_mps=2.0,
    speed_std_mps=0.05,
    accel_mps2=0.0,
    distance_m=0.0,
    unbalanced=0.04,
    share=0.04,
    slope_x=0.0,
    slope_y=0.0,
    slope_var=1e-5,
    sine_x=0.0,
    pitch_radps=0.0,
    yaw_radps=0.0,
    norm_mps2=GRAVITY_MPS2,
    on_front=0.0,
    body_mps2=0.0,
    torque_s=0.01,
    wheels_s=0.02,
    mass_kg=17_500.0,
    brake=0.0,
)


def after(steps: int, **options: Any) -> Balance:
    """The steady balance this many steps later, changed."""
    return replace(STEADY, stamp_ns=START_NS + steps * round(STEP_S * 1e9), distance_m=0.1 * steps, **options)


def balances(machine: MachineConfig, readings: Iterable[Reading], *, weighs: bool = True) -> list[Balance]:
    balancer, dead_reckoning = Balancer(machine, weighs=weighs), DeadReckoning(machine, 0.0)
    made = []
    for reading in readings:
        sensor = machine.sensor(reading.sensor)
        dead_reckoning.update(reading, sensor)
        if balance := balancer.update(reading, sensor, dead_reckoning):
            made.append(balance)
    return made


class EstimatorRun:
    """A ground estimator fed with readings and asked at 10 Hz for an estimate of a moment ago."""

    def __init__(
        self,
        machine: MachineConfig,
        config: EstimationConfig | None = None,
        *,
        calibration: Calibration | None = None,
        tuning: EstimationTuning = TUNING,
        known_c_rr: float | None = None,
        knows_place: bool = False,
    ) -> None:
        """knows_place: by dead reckoning."""
        self.estimator = GroundEstimator(machine, config or EstimationConfig(), calibration, tuning)
        self.dead_reckoning = DeadReckoning(machine, 0.0)
        self.estimates: list[tuple[int, GroundEstimate]] = []
        self._machine, self._known_c_rr = machine, known_c_rr
        self._asked_ns = 0
        self._knows_place = knows_place

    def feed(self, readings: Iterable[Reading]) -> EstimatorRun:
        for reading in readings:
            sensor = self._machine.sensor(reading.sensor)
            self.dead_reckoning.update(reading, sensor)
            self.estimator.update(reading, sensor, self.dead_reckoning, self._known_c_rr, self._pose())
            if reading.stamp_ns - self._asked_ns >= 100_000_000:
                self._asked_ns = reading.stamp_ns
                stamp_ns = reading.stamp_ns - 1_500_000_000
                self.estimates.append((stamp_ns, self.estimator.at(stamp_ns)))
        return self

    def _pose(self) -> PoseBelief | None:
        at = self.dead_reckoning.pose
        speed_mps = self.dead_reckoning.wheels.speed_mps
        pose = PoseBelief(at.stamp_ns, at.x_m, at.y_m, at.angle_rad, speed_mps, np.eye(2))
        return pose if self._knows_place else None

    @property
    def last(self) -> GroundEstimate:
        """The last answer."""
        return self.estimates[-1][1]

    def between(self, start_s: float, end_s: float) -> list[GroundEstimate]:
        """Answers for this time of the drive."""
        return [e for ns, e in self.estimates if start_s <= (ns - START_NS) * 1e-9 < end_s]


def level_steps(raw: Iterable[float], *, share: Iterable[float] | float = 0.04) -> list[BalanceStep]:
    """Level ground, forwards at 2 m/s."""
    raw = list(raw)
    shares = np.broadcast_to(np.array(share, float), len(raw))
    return [
        BalanceStep(START_NS + i * round(STEP_S * 1e9), STEP_S, 2.0 * STEP_S, float(z), 1.0, float(s))
        for i, (z, s) in enumerate(zip(raw, shares, strict=True))
    ]


def feed(estimator: KalmanResistance | RecursiveResistance, steps: Iterable[BalanceStep]) -> None:
    for step in steps:
        estimator.update(step)


def white_noise(density: float, n: int, rng: np.random.Generator) -> Floats:
    """n steps."""
    return density / math.sqrt(STEP_S) * np.asarray(rng.standard_normal(n))
