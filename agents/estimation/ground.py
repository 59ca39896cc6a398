"""Rolling resistance and slope of the ground under one machine, with the calibration that it finds at work.

Readings become balances of force (`balance`), those that tell nothing are set aside with a reason (`plausibility`),
and an estimator follows c_rr over the rest (`kalman`, `recursive`). What is asked for a stamp may be asked a little
later, so that what came after it helps.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from agents.dead_reckoning import DeadReckoning
from agents.estimation.attitude import AttitudeConfig
from agents.estimation.balance import Balance, Balancer
from agents.estimation.calibration import Calibration, CalibrationConfig, Calibrator, unknown
from agents.estimation.plausibility import FAULTS, SLOPE_TOO, Plausibility, PlausibilityConfig
from agents.estimation.resistance import Push, Resistance
from agents.estimation.resistance_kalman import KalmanConfig, KalmanResistance
from agents.estimation.resistance_rls import RecursiveConfig, RecursiveGrade, RecursiveResistance
from protocol.config import require_positive
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Reading

ESTIMATORS = ("kalman", "rls")
MASSES = ("message", "known", "estimated")
KEPT = 400  # steps that are remembered: 20 s
NEAR_NS = 200_000_000  # a slope this far from its stamp is none
SILENT_NS = 1_000_000_000  # other sensors speak, but no step was made for so long
LOADING_S = 3.0  # a machine that stands so long may take or leave a load


@dataclass(frozen=True)
class EstimationConfig:
    """How the ground is estimated.

    estimator: "kalman", or "rls" (least squares with multiple forgetting, as the paper has it). mass: "message" (the
    machine's, and what payload readings add), "known" (the machine's alone) or "estimated" (from forces). calibrate:
    whether zero and scale of the force balance are found at work. step_s: of the balance. model_std: error of the
    balance itself [-], which no calibration takes away.
    """

    estimator: str = "kalman"
    mass: str = "message"
    calibrate: bool = True
    step_s: float = 0.05
    model_std: float = 0.0015
    kalman: KalmanConfig = field(default_factory=KalmanConfig)
    recursive: RecursiveConfig = field(default_factory=RecursiveConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    plausibility: PlausibilityConfig = field(default_factory=PlausibilityConfig)
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)

    def __post_init__(self) -> None:
        for name, known in (("estimator", ESTIMATORS), ("mass", MASSES)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: {getattr(self, name)!r} is none of {', '.join(known)}")
        require_positive(self, ("step_s", "model_std"))


@dataclass(frozen=True)
class GroundEstimate:
    """What is known of the ground at a stamp.

    c_rr, c_rr_var: NaN where `reason` says why nothing is known of it, "" else. slope_x, slope_y: rise over run ahead
    and to the left, slope_var of either; NaN without accelerometer.
    """

    c_rr: float
    c_rr_var: float
    slope_x: float
    slope_y: float
    slope_var: float
    reason: str

    @property
    def is_blurred(self) -> bool:
        """Whether the slope is worth nothing either."""
        return self.reason in SLOPE_TOO


NOTHING_KNOWN = GroundEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, "no_imu")


@dataclass(frozen=True, slots=True)
class _Moment:
    """A balance as it was judged, and the slope ahead by the estimator in use [rad]."""

    stamp_ns: int
    balance: Balance
    reason: str
    slope_x: float


class GroundEstimator:
    """Estimator of one machine; `update` takes readings in the order of their stamps."""

    def __init__(self, machine: MachineConfig, config: EstimationConfig, known: Calibration | None = None) -> None:
        """known: a calibration from before."""
        self._machine, self._config = machine, config
        self._balancer = Balancer(machine, config.step_s, config.attitude, weighs=config.mass == "message")
        self._plausibility = Plausibility(config.plausibility)
        self._calibrator = Calibrator(config.calibration, known)
        self._applied = unknown(config.calibration)
        estimates_mass = config.mass == "estimated"
        self._resistance: Resistance = (
            KalmanResistance(config.kalman, estimates_mass=estimates_mass)
            if config.estimator == "kalman"
            else RecursiveResistance(config.recursive, estimates_mass=estimates_mass)
        )
        self._grade = RecursiveGrade(config.recursive) if config.estimator == "rls" else None
        self._moments: deque[_Moment] = deque(maxlen=KEPT)
        self._used_m = 0.0
        self._stands_s = 0.0
        self._heard_ns = 0  # of any sensor

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest step; 0 before the first."""
        return self._moments[-1].stamp_ns if self._moments else 0

    @property
    def fault(self) -> str:
        """The sensor fault of this moment that keeps resistance from being known, "" if none does."""
        if self._heard_ns - self.newest_ns > SILENT_NS:
            return NOTHING_KNOWN.reason
        reason = self._moments[-1].reason if self._moments else ""
        return reason if reason in FAULTS else ""

    @property
    def calibration(self) -> Calibration:
        """What was found at work."""
        return self._calibrator.calibration

    def health(self) -> dict[str, Any]:
        """State in plain values."""
        known = self._applied
        age_s = (self.newest_ns - known.stamp_ns) * 1e-9 if known.stamp_ns else None
        return {
            "fault": self.fault,
            "payload_kg": self._balancer.payload_kg,
            "calibration": {
                "zero": known.zero,
                "zero_std": math.sqrt(known.covariance[0][0]),
                "scale": known.scale,
                "scale_std": math.sqrt(known.covariance[1][1]),
                "age_s": age_s,
                "passages": known.passages,
                **self._calibrator.counters,
            },
        }

    def update(
        self, reading: Reading, sensor: SensorConfig, dead: DeadReckoning, known_c_rr: float | None = None
    ) -> None:
        """Take in a reading, after dead reckoning did. known_c_rr: of the ground here, where the site says it."""
        self._heard_ns = max(self._heard_ns, reading.stamp_ns)
        if balance := self._balancer.update(reading, sensor, dead):
            self._step(balance, dead, known_c_rr)

    def at(self, stamp_ns: int) -> GroundEstimate:
        """The estimate for a recent stamp, with what came after it."""
        index = bisect_left(self._moments, stamp_ns, key=lambda moment: moment.stamp_ns)
        near = [m for m in list(self._moments)[max(index - 1, 0) : index + 1] if abs(m.stamp_ns - stamp_ns) <= NEAR_NS]
        if not near:
            return NOTHING_KNOWN
        moment = min(near, key=lambda m: abs(m.stamp_ns - stamp_ns))
        balance, known = moment.balance, self._applied
        found = None if moment.reason else self._resistance.at(stamp_ns)
        c_rr, variance = math.nan, math.nan
        if found:
            cosine = math.cos(moment.slope_x)
            c_rr = found[0]
            variance = found[1] + known.variance(balance.share) / cosine**2 + self._config.model_std**2
        reason = moment.reason or ("" if found else "settling")
        slope_x = math.tan(moment.slope_x + known.zero)  # the zero is the accelerometer's, whose slope is off alike
        # Of both directions: work shows the zero ahead, nothing that of the one across.
        slope_var = balance.slope_var + (known.covariance[0][0] + self._config.calibration.zero**2) / 2
        return GroundEstimate(c_rr, variance, slope_x, math.tan(balance.slope_y), slope_var, reason)

    def _step(self, balance: Balance, dead: DeadReckoning, known_c_rr: float | None) -> None:
        if not self._moments:
            self._apply(balance.stamp_ns)
        cosine = math.cos(balance.slope_x)
        raw = self._applied.corrected(balance)
        reason = self._plausibility.judge(balance, balance.direction * raw / cosine)
        slope_x = self._grade.update(balance.dt_s, balance.sine_x) if self._grade else balance.slope_x
        self._moments.append(_Moment(balance.stamp_ns, balance, reason, slope_x))
        if reason == "standstill":
            self._rest(balance)
        if reason:
            self._calibrator.interrupt()
            return
        self._stands_s = 0.0
        way_m, self._used_m = balance.way_m - self._used_m, balance.way_m
        self._resistance.update(self._push(balance, way_m, raw, balance.direction * cosine))
        if self._config.calibrate:
            self._calibrator.update(balance, dead, known_c_rr)

    def _push(self, balance: Balance, way_m: float, raw: float, regressor: float) -> Push:
        machine, forwards = self._machine, balance.direction > 0
        axles = (1.0, 0.0, 0.0)
        if machine.wheelbase_m:
            lead_share = balance.on_front if forwards else 1 - balance.on_front
            lead_m = machine.wheelbase_m - machine.load_centre_m if forwards else machine.load_centre_m
            axles = (lead_share, machine.wheelbase_m, lead_m)
        return Push(balance.stamp_ns, balance.dt_s, way_m, raw, regressor, balance.share, *axles)

    def _rest(self, balance: Balance) -> None:
        """A new calibration takes effect while the machine stands: the ground must not seem to change as it drives."""
        self._stands_s += balance.dt_s
        self._apply(balance.stamp_ns)
        self._resistance.rest(changes_load=self._stands_s > LOADING_S)

    def _apply(self, stamp_ns: int) -> None:
        """Take up what was found out so far."""
        if self._config.calibrate:
            self._calibrator.age(stamp_ns)
            self._applied = self._calibrator.calibration
