"""Rolling resistance and slope under one machine, with its calibration at work.

Readings become force balances (`balance`); unusable ones are excluded with a reason (`plausibility`); an estimator
tracks c_rr (`resistance_kalman`, `resistance_rls`). Estimates are read late, so that later steps help.
"""

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

from agents.dead_reckoning import LOADING_S, DeadReckoning
from agents.estimation.balance import Balance, Balancer, BalanceStep
from agents.estimation.calibration import UNCALIBRATED, Calibration, Calibrator
from agents.estimation.closed_tours import ClosedTours
from agents.estimation.offers import Offers
from agents.estimation.plausibility import FAULTS, SLOPE_TOO, Plausibility
from agents.estimation.resistance_kalman import KalmanResistance
from agents.estimation.resistance_rls import RecursiveGrade, RecursiveResistance
from agents.estimation.shaking import LongerSteps
from agents.estimation.skid_steering import SkidSteering
from agents.estimation.tuning import TUNING, EstimationTuning
from agents.localisation.filters.belief import PoseBelief
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Reading
from protocol.machine.samples import ZERO_STD

ESTIMATORS = ("kalman", "rls")
MASSES = ("message", "known", "estimated")
KEPT = 400  # steps: 20 s
NEAR_NS = 200_000_000  # greatest distance of a stamp from a step
SILENT_NS = 1_000_000_000  # time without a step, though other sensors report, that is a fault
JOLTS = frozenset({"accelerometer", "slip"})  # the accelerometer does not show the slope ahead
MAX_LOADED = 4.0  # upper bound of loaded over empty mass


@dataclass(frozen=True)
class EstimationConfig:
    """How the ground is estimated.

    estimator: "kalman", or "rls" (least squares with multiple forgetting, as in the paper). mass: "message" (machine
    plus payload readings), "known" (machine) or "estimated" (by forces). calibrate: whether to estimate bias and scale
    at work. closed_tours: also by closed loops; no track may pass over another. accept_calibration: whether the map
    server's offers count.
    """

    estimator: str = "kalman"
    mass: str = "message"
    calibrate: bool = True
    closed_tours: bool = True
    accept_calibration: bool = False

    def __post_init__(self) -> None:
        for name, choices in (("estimator", ESTIMATORS), ("mass", MASSES)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: {getattr(self, name)!r} is none of {', '.join(choices)}")
        if self.accept_calibration and not self.calibrate:
            raise ValueError(
                "accept_calibration: an offer is one estimate among the machine's own: set `calibrate` too"
            )


@dataclass(frozen=True)
class GroundEstimate:
    """The ground at a stamp.

    c_rr, c_rr_var: NaN if unknown; `reason` says why, else "". slope_x, slope_y, slope_var: rise over run ahead and
    left; NaN if unknown. zero, scale: applied calibration. mass_kg: with payload, NaN if unknown.
    """

    c_rr: float
    c_rr_var: float
    slope_x: float
    slope_y: float
    slope_var: float
    reason: str
    zero: float = 0.0
    scale: float = 0.0
    mass_kg: float = math.nan


NOTHING_KNOWN = GroundEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, "no_imu")


@dataclass(frozen=True, slots=True)
class _JudgedBalance:
    """A judged balance; slope_x of the estimator in use [rad]."""

    stamp_ns: int
    balance: Balance
    reason: str
    slope_x: float


class GroundEstimator:
    """Estimator of one machine; readings in stamp order."""

    def __init__(
        self,
        machine: MachineConfig,
        config: EstimationConfig,
        calibration: Calibration | None = None,
        tuning: EstimationTuning = TUNING,
    ) -> None:
        """Start, with the `calibration` of an earlier run."""
        self._machine, self._config, self._tuning = machine, config, tuning
        self._balancer = Balancer(machine, weighs=config.mass == "message")
        self._plausibility = Plausibility(machine.wheelbase_m)
        self._longer = LongerSteps()
        self._skid_steering = SkidSteering(machine)
        self._calibrator = Calibrator(calibration, tuning)
        self._tours = ClosedTours()
        self._offers = Offers(machine.name, calibration.offer_ns if calibration else 0)
        self._applied = UNCALIBRATED
        estimates_mass = config.mass == "estimated"
        self._resistance: KalmanResistance | RecursiveResistance = (
            KalmanResistance(estimates_mass=estimates_mass, tuning=tuning)
            if config.estimator == "kalman"
            else RecursiveResistance(estimates_mass=estimates_mass)
        )
        self._grade = RecursiveGrade() if config.estimator == "rls" else None
        self._judged: deque[_JudgedBalance] = deque(maxlen=KEPT)
        self._usable_m = 0.0
        self._stands_s = 0.0
        self._newest_reading_ns = 0  # of any sensor

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest step; 0 before the first."""
        return self._judged[-1].stamp_ns if self._judged else 0

    @property
    def fault(self) -> str:
        """Sensor fault that hides the resistance, or ""."""
        if self._newest_reading_ns - self.newest_ns > SILENT_NS:
            return NOTHING_KNOWN.reason
        reason = self._judged[-1].reason if self._judged else ""
        return reason if reason in FAULTS else ""

    @property
    def estimated_mass_kg(self) -> float | None:
        """Mass with payload by forces, m / (1 - scale error); None if not configured."""
        if self._config.mass != "estimated":
            return None
        return self._machine.mass_kg / max(1 - self._resistance.scale, 1 / MAX_LOADED)

    @property
    def traction(self) -> float | None:
        """Drive force over weight by engine or motor, else None."""
        newest = self._judged[-1].balance if self._judged and self._balancer.is_before_wheels else None
        return newest.share if newest and not newest.unknown else None

    @property
    def calibration(self) -> Calibration:
        """Bias and scale so far."""
        return self._calibrator.calibration

    def health(self) -> dict[str, Any]:
        """State in plain values."""
        applied = self._applied
        age_s = (self.newest_ns - applied.stamp_ns) * 1e-9 if applied.stamp_ns else None
        return {
            "fault": self.fault,
            "payload_kg": self._balancer.payload_kg,
            "skid_steers": self._skid_steering.is_so,
            "calibration": {
                "calibrates": self._config.calibrate,
                "zero": applied.zero,
                "zero_std": math.sqrt(applied.covariance[0][0]),
                "scale": applied.scale,
                "scale_std": math.sqrt(applied.covariance[1][1]),
                "age_s": age_s,
                "passages": applied.passages,
                **self._calibrator.counters,
                "torn": self._tours.torn,
                "accepts_offers": self._config.accept_calibration,
                "offer_ns": applied.offer_ns,
                **self._offers.counters,
            },
        }

    def update(
        self,
        reading: Reading,
        sensor: SensorConfig,
        dead_reckoning: DeadReckoning,
        known_c_rr: float | None = None,
        pose: PoseBelief | None = None,
    ) -> None:
        """Add a reading, after dead reckoning. known_c_rr: of the ground here, if the site states it."""
        self._newest_reading_ns = max(self._newest_reading_ns, reading.stamp_ns)
        self._skid_steering.update(reading, sensor, dead_reckoning)
        if balance := self._balancer.update(reading, sensor, dead_reckoning):
            self._step(balance, dead_reckoning, known_c_rr)
            if self._config.calibrate and self._config.closed_tours:
                self._follow(balance, pose)

    def consider(self, offer: Any) -> None:
        """Judge an unvalidated offer; a good one counts at the next calibration change."""
        if self._config.accept_calibration:
            self._offers.consider(offer, self._newest_reading_ns)

    def at(self, stamp_ns: int) -> GroundEstimate:
        """Estimate at a recent stamp, using later steps."""
        judged = self._nearest(stamp_ns)
        if judged is None:
            return replace(NOTHING_KNOWN, mass_kg=self._known_mass(self._balancer.mass_kg))
        balance, applied = judged.balance, self._applied
        if judged.reason in SLOPE_TOO:
            return replace(NOTHING_KNOWN, reason=judged.reason, mass_kg=self._known_mass(balance.mass_kg))
        resistance = None if judged.reason else self._resistance.at(stamp_ns)
        c_rr, variance = math.nan, math.nan
        if resistance:
            cosine = math.cos(judged.slope_x)
            c_rr = resistance[0]
            steady_var = applied.variance(balance.share) + balance.share_var
            variance = resistance[1] + steady_var / cosine**2 + self._tuning.model_std**2
        reason = judged.reason or ("" if resistance else "settling")
        slope_x = math.tan(judged.slope_x + applied.zero)  # the accelerometer's bias is an error of the slope too
        # Mean of both directions: nothing shows the bias across.
        slope_var = balance.slope_var + (applied.covariance[0][0] + ZERO_STD**2) / 2
        slope_y, calibration = math.tan(balance.slope_y), (applied.zero, applied.scale)
        mass_kg = self._known_mass(balance.mass_kg)
        return GroundEstimate(c_rr, variance, slope_x, slope_y, slope_var, reason, *calibration, mass_kg)

    def _known_mass(self, mass_kg: float) -> float:
        """The weighed mass, if it is not estimated."""
        return math.nan if self._config.mass == "estimated" else mass_kg

    def _nearest(self, stamp_ns: int) -> _JudgedBalance | None:
        index = bisect_left(self._judged, stamp_ns, key=lambda judged: judged.stamp_ns)
        around = list(self._judged)[max(index - 1, 0) : index + 1]
        nearest = min(around, key=lambda judged: abs(judged.stamp_ns - stamp_ns), default=None)
        return nearest if nearest and abs(nearest.stamp_ns - stamp_ns) <= NEAR_NS else None

    def _step(self, balance: Balance, dead_reckoning: DeadReckoning, known_c_rr: float | None) -> None:
        if not self._judged:
            self._apply_calibration(balance.stamp_ns)
        cosine = math.cos(balance.slope_x)
        raw = self._applied.corrected(balance)
        skids = self._skid_steering.turns(balance)
        reason = self._plausibility.judge(balance, balance.direction * raw / cosine, skids=skids)
        slope_x = self._grade.update(balance.dt_s, balance.sine_x) if self._grade else balance.slope_x
        self._judged.append(_JudgedBalance(balance.stamp_ns, balance, reason, slope_x))
        if reason == "standstill":
            self._stand(balance)
        if reason:
            self._calibrator.interrupt()
            return
        self._stands_s = 0.0
        distance_m, self._usable_m = balance.distance_m - self._usable_m, balance.distance_m
        step = self._balance_step(balance, distance_m, raw, balance.direction * cosine)
        shaking_var = self._plausibility.shaking_var
        for ready in self._longer.add(step, shakes=shaking_var > 0):
            self._resistance.update(ready)
        if self._config.calibrate:
            self._calibrator.update(balance, dead_reckoning, known_c_rr, shaking_var)

    def _follow(self, balance: Balance, pose: PoseBelief | None) -> None:
        """Follow the track; a loop takes effect at once, since a machine on loops may never stand."""
        reason = self._judged[-1].reason
        if reason == "no_wheels":  # distance unknown
            self._tours.interrupt()
        elif tour := self._tours.update(balance, pose, is_jolted=reason in JOLTS):
            self._calibrator.add_tour(tour)
            self._apply_calibration(balance.stamp_ns)

    def _balance_step(self, balance: Balance, distance_m: float, raw: float, regressor: float) -> BalanceStep:
        machine, forwards = self._machine, balance.direction > 0
        axles = (1.0, 0.0, 0.0)
        if machine.wheelbase_m:
            lead_share = balance.on_front if forwards else 1 - balance.on_front
            lead_m = machine.wheelbase_m - machine.load_centre_m if forwards else machine.load_centre_m
            axles = (lead_share, machine.wheelbase_m, lead_m)
        step = BalanceStep(balance.stamp_ns, balance.dt_s, distance_m, raw, regressor, balance.share, *axles)
        return replace(step, share_var=balance.share_var) if balance.share_var else step

    def _stand(self, balance: Balance) -> None:
        """Apply the calibration at standstill; passages change it in small steps."""
        self._stands_s += balance.dt_s
        self._apply_calibration(balance.stamp_ns)
        self._resistance.stand(changes_load=self._stands_s > LOADING_S)

    def _apply_calibration(self, stamp_ns: int) -> None:
        if self._config.calibrate:
            self._calibrator.age(stamp_ns)
            if offer := self._offers.take():
                self._calibrator.take(offer, stamp_ns)
            before, self._applied = self._applied, self._calibrator.calibration
            zero, scale = self._applied.zero - before.zero, self._applied.scale - before.scale
            if zero or scale:
                self._longer.clear()  # still with the old calibration
                self._resistance.recalibrate(zero, scale)
