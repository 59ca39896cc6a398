"""The localiser: readings in, beliefs about the pose out. Until it knows its heading it only collects."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from agents.localisation import model
from agents.localisation.odometry import Alignment, Dead, DeadReckoning, align, mean_std, step_between
from agents.localisation.ukf import VectorisedUkf
from protocol.arrays import Floats
from protocol.machine import MachineConfig, SensorConfig
from protocol.readings import Gps, Reading
from protocol.site import Projection

TWO_PI = 2 * math.pi
COLLECTED = 12_000  # steps and fixes kept while the heading is unknown: 20 minutes; a machine that waits needs no more
MIN_DRIFT_M2 = 1e-6  # a receiver that was never heard, or has no slow error, must not make the covariance singular


@dataclass(frozen=True)
class LocalisationConfig:
    """How GPS is used and how often the filter steps.

    align_way_m: how far to drive before the start heading is taken from GPS. align_spread_m: how far the positions
    must spread. step_s: longest prediction step. gate_sigma: fixes further off are refused. relock_fixes: so many
    refused in a row, and the filter opens up again. min_fix_std_m: no fix is taken for better than this.
    standstill_s: after this long without travel the gyro's rate is taken as its bias.
    """

    align_way_m: float = 12.0
    align_spread_m: float = 3.0
    step_s: float = 0.1
    gate_sigma: float = 4.0
    relock_fixes: int = 15
    min_fix_std_m: float = 0.3
    standstill_s: float = 1.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")


@dataclass(frozen=True)
class PoseBelief:
    """Pose in `map` at a stamp: position [m], heading [rad, in +-pi], wheel speed [m/s], covariance (2, 2) [m2]."""

    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    covariance_m2: Floats


@dataclass(frozen=True)
class _Fix:
    """A fix in `map` with what the filter needs of it."""

    stamp_ns: int
    receiver: int
    position_m: Floats
    white_m2: Floats
    drift_m2: float
    dead: Dead


class Localiser:
    """UKF over pose, gyro bias, wheel scale and GPS errors.

    `update` takes readings in the order of their stamps and returns the new beliefs; after the alignment these start
    with the pose at which the alignment began, so nothing that was driven is lost.
    """

    def __init__(
        self, machine: MachineConfig, projection: Projection, config: LocalisationConfig, noise: model.ModelConfig
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.dead = DeadReckoning(machine, noise.slip)
        self.last_nis = math.nan
        self._config = config
        self._noise = noise
        self._projection = projection
        receivers = [s for s in machine.sensors if s.kind == "gps" and s.use]
        self._receivers = {s.name: i for i, s in enumerate(receivers)}
        self._levers = [(s.mount.xyz_m[0], s.mount.xyz_m[1]) for s in receivers]
        self._drift_time_s = np.array([s.drift_time_s for s in receivers])
        self._drift_m2 = np.full(len(receivers), MIN_DRIFT_M2)
        self._heard: set[int] = set()
        self._filter: VectorisedUkf | None = None
        self._at = Dead(0, 0.0, 0.0, 0.0, 0.0)  # dead-reckoned pose of the filter's last step
        self._track: deque[Dead] = deque(maxlen=COLLECTED)
        self._fixes: deque[_Fix] = deque(maxlen=COLLECTED)
        self._gated: Counter[int] = Counter()
        self._still: deque[Dead] = deque()

    @property
    def is_aligned(self) -> bool:
        """Whether the heading is known."""
        return self._filter is not None

    def update(self, reading: Reading, sensor: SensorConfig) -> list[PoseBelief]:
        """Take in one reading; returns beliefs that it made possible, oldest first."""
        if isinstance(reading, Gps):
            return self._update_gps(reading, sensor)
        self.dead.update(reading, sensor)
        return self._step_if_due()

    def _step_if_due(self) -> list[PoseBelief]:
        now = self.dead.now()
        last = self._track[-1].stamp_ns if self._track and not self.is_aligned else self._at.stamp_ns
        if now.stamp_ns - last < self._config.step_s * 1e9:
            return []
        if self._filter is None:
            self._track.append(now)
            return []
        self._predict(self._filter, now)
        self._watch_standstill(self._filter, now)
        return [self._belief(self._filter)]

    # --- GPS ---------------------------------------------------------------------------------------------------------

    def _update_gps(self, gps: Gps, sensor: SensorConfig) -> list[PoseBelief]:
        fix = self._fix(gps, sensor)
        if self._filter is None:
            self._fixes.append(fix)
            return self._try_align()
        self._predict(self._filter, fix.dead)
        self._condition(self._filter, fix)
        return [self._belief(self._filter)]

    def _fix(self, gps: Gps, sensor: SensorConfig) -> _Fix:
        x, y, _ = self._projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        variance = np.array([gps.var_e_m2, gps.var_n_m2])
        drift_m2 = max(sensor.drift_share * float(variance.mean()), MIN_DRIFT_M2)
        white = np.maximum(variance * (1 - sensor.drift_share), self._config.min_fix_std_m**2)
        dead = self.dead.now()
        stamped = Dead(max(dead.stamp_ns, gps.stamp_ns), dead.travel_m, dead.angle_rad, dead.x_m, dead.y_m, dead.pull)
        return _Fix(gps.stamp_ns, self._receivers[gps.sensor], np.array([x, y]), white, drift_m2, stamped)

    def _condition(self, ukf: VectorisedUkf, fix: _Fix) -> None:
        lever, receiver = self._levers[fix.receiver], fix.receiver
        if receiver not in self._heard:  # a receiver that comes late brings its own unknown error
            self._heard.add(receiver)
            states = model.drift_states(receiver)
            ukf.P[states, states] = np.eye(2) * fix.drift_m2
        self._drift_m2[receiver] = fix.drift_m2
        R = np.diag(fix.white_m2)
        y, S, cross = ukf.innovation(fix.position_m, lambda s: model.antenna(s, lever, receiver), R)
        self.last_nis = float(y @ np.linalg.solve(S, y))
        if self.last_nis > self._config.gate_sigma**2:
            self._gated[receiver] += 1
            self.counters["gps_gated"] += 1
            if self._gated[receiver] < self._config.relock_fixes:
                return
            self.counters["gps_relocked"] += 1
            ukf.P[model.POSITION, model.POSITION] += np.outer(y, y) + np.eye(2)
            y, S, cross = ukf.innovation(fix.position_m, lambda s: model.antenna(s, lever, receiver), R)
        self._gated[receiver] = 0
        self.counters["gps_used"] += 1
        ukf.condition(y, S, cross)

    # --- prediction --------------------------------------------------------------------------------------------------

    def _predict(self, ukf: VectorisedUkf, to: Dead) -> None:
        step = step_between(self._at, to)
        if step.dt_s > 0:
            decay = np.exp(-step.dt_s / self._drift_time_s)
            noise = model.process_noise(step, float(ukf.x[model.HEADING]), decay, self._drift_m2, self._noise)
            ukf.predict_with(lambda sigmas: model.move(sigmas, step, decay), noise)
            self._at = to

    def _watch_standstill(self, ukf: VectorisedUkf, now: Dead) -> None:
        """At rest the gyro shows its bias: condition on it once per standstill_s, unless the frame turns (steering)."""
        if self._still and now.travel_m != self._still[0].travel_m:
            self._still.clear()
        self._still.append(now)
        step = step_between(self._still[0], now)
        if step.dt_s >= self._config.standstill_s:
            rate, R = np.array([step.turn_rad / step.dt_s]), np.array([[1e-6]])
            y, S, cross = ukf.innovation(rate, lambda s: s[:, model.GYRO_BIAS, None], R)
            is_bias = y[0] ** 2 <= self._config.gate_sigma**2 * S[0, 0]
            self.counters["standstill_updates" if is_bias else "standstill_gated"] += 1
            if is_bias:
                ukf.condition(y, S, cross)
            self._still.clear()

    def _belief(self, ukf: VectorisedUkf) -> PoseBelief:
        heading = float((ukf.x[model.HEADING] + math.pi) % TWO_PI - math.pi)
        x, y = ukf.x[model.POSITION]
        covariance = ukf.P[model.POSITION, model.POSITION].copy()
        speed = self.dead.wheels.speed_mps
        return PoseBelief(self._at.stamp_ns, float(x), float(y), heading, speed, covariance)

    # --- alignment ---------------------------------------------------------------------------------------------------

    def _try_align(self) -> list[PoseBelief]:
        """Start the filter once the way driven shows the heading, and run it over what was collected."""
        if self.dead.way_m < self._config.align_way_m or len(self._fixes) < 4 or not self._track:
            return []
        antennas = np.array([self._dead_antenna(fix) for fix in self._fixes])
        if float(np.sqrt(((antennas - antennas.mean(axis=0)) ** 2).sum(axis=1).mean())) < self._config.align_spread_m:
            return []
        fixes = np.array([fix.position_m for fix in self._fixes])
        std = mean_std([fix.drift_m2 + float(fix.white_m2.mean()) for fix in self._fixes])
        found = align(antennas, fixes, std)
        return self._start(found, std) if found else []

    def _dead_antenna(self, fix: _Fix) -> tuple[float, float]:
        lever, c, s = self._levers[fix.receiver], math.cos(fix.dead.angle_rad), math.sin(fix.dead.angle_rad)
        return fix.dead.x_m + c * lever[0] - s * lever[1], fix.dead.y_m + s * lever[0] + c * lever[1]

    def _start(self, found: Alignment, fix_std_m: float) -> list[PoseBelief]:
        first = self._track[0]
        c, s = math.cos(found.rotation_rad), math.sin(found.rotation_rad)
        x = np.zeros(model.BASE_STATES + 2 * len(self._receivers))
        x[0] = found.origin_m[0] + c * first.x_m - s * first.y_m
        x[1] = found.origin_m[1] + s * first.x_m + c * first.y_m
        x[model.HEADING] = found.rotation_rad + first.angle_rad
        for fix in self._fixes:
            self._drift_m2[fix.receiver] = fix.drift_m2
            self._heard.add(fix.receiver)
        self._filter = VectorisedUkf(x, self._start_covariance(len(x), found, fix_std_m))
        self._at = first
        events: list[Dead | _Fix] = [*list(self._track)[1:], *self._fixes]
        beliefs = [self._belief(self._filter)]
        for event in sorted(events, key=lambda e: e.stamp_ns):
            dead = event.dead if isinstance(event, _Fix) else event
            self._predict(self._filter, dead)
            if isinstance(event, _Fix):
                self._condition(self._filter, event)
            beliefs.append(self._belief(self._filter))
        self._track.clear()
        self._fixes.clear()
        return beliefs

    def _start_covariance(self, n: int, found: Alignment, fix_std_m: float) -> Floats:
        """Start covariance: the fixes are used again by the filter, so the position is left wide."""
        variance = np.zeros(n)
        variance[model.POSITION] = (2 * fix_std_m) ** 2
        variance[model.HEADING] = min(0.5, 2 * found.std_rad + 0.05) ** 2
        variance[model.GYRO_BIAS] = self._noise.gyro_bias_radps**2
        variance[model.WHEEL_SCALE] = self._noise.wheel_scale**2
        variance[model.BASE_STATES :] = np.repeat(self._drift_m2, 2)
        return np.diag(variance)
