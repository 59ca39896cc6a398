"""The localiser: readings in, beliefs about the pose out. Until it knows its heading it only collects."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from agents.localisation import sensing
from agents.localisation.belief import Belief, Filter, Measurement, Motion, PoseBelief
from agents.localisation.ekf import Ekf
from agents.localisation.fusion import Fusion, FusionConfig
from agents.localisation.kinematics import GpsError, MotionConfig, motion
from agents.localisation.odometry import Alignment, Dead, DeadReckoning, align, mean_std
from agents.localisation.sensing import SensingConfig
from agents.localisation.state import ACCELERATION, ATTITUDE, POSITION, RATE, SPEED, VELOCITY, YAW, Layout
from agents.localisation.steps import Step, Steps
from agents.localisation.unscented import Ukf
from agents.localisation.watch import Consistency, Watch
from agents.physics import GRAVITY_MPS2
from protocol.arrays import Floats
from protocol.machine import MachineConfig, SensorConfig
from protocol.readings import Gps, Reading
from protocol.site import Projection

COLLECTED = 24_000  # steps and fixes kept while the heading is unknown: 20 minutes; a machine that waits needs no more
MIN_DRIFT_M2 = 1e-6  # a receiver without slow error must not make the covariance singular
START_MPS = 3.0  # how unsure the first speed is: the machine may drive already, and wheels take a moment to tell
ROLLING_S = 0.5
UNKNOWN_STD = 1e4  # of what a sensor does not give
TOLD_STD_M, TOLD_STD_RAD = 0.5, 0.02  # of a start that is told
ENGINES = {"ekf": Ekf, "ukf": Ukf}
PROFILES = ("default", "paper")
POSITIVE = (  # numbers of the configuration
    "step_s",
    "align_way_m",
    "align_spread_m",
    "standstill_s",
    "slip_std",
    "slip_time_s",
    "gyro_bias_radps",
    "wheel_scale",
)


@dataclass(frozen=True)
class LocalisationConfig:
    """How positions are found.

    filter: ekf or ukf. profile: "paper" takes GPS errors as white; "default" estimates a slow error of each receiver, a
    bias of each yaw gyro and the wheels' scale. step_s: of the filter. align_way_m: how far to drive before the start
    heading is taken from GPS. align_spread_m: how far the positions must spread. standstill_s: after this long without
    travel the machine stands. start: x, y [m] and heading [rad] in `map`, where they are known: no alignment is needed
    then, nor GPS. slip, slip_soft, slip_std: wheel slip per traction on firm ground, how much it rises with the rolling
    resistance (ground that resists gives way), and how unsure both are together. slip_time_s: how long a ground's slip
    stays the same. gyro_bias_radps, wheel_scale: standard deviations at first.
    """

    filter: str = "ukf"
    profile: str = "default"
    step_s: float = 0.05
    align_way_m: float = 12.0
    align_spread_m: float = 3.0
    standstill_s: float = 1.0
    start: tuple[float, ...] = ()
    slip: float = 0.1
    slip_soft: float = 0.9
    slip_std: float = 0.08
    slip_time_s: float = 5.0
    gyro_bias_radps: float = 5e-3
    wheel_scale: float = 0.03
    motion: MotionConfig = field(default_factory=MotionConfig)
    sensing: SensingConfig = field(default_factory=SensingConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)

    def __post_init__(self) -> None:
        if self.filter not in ENGINES:
            raise ValueError(f"filter: {self.filter!r} is neither {' nor '.join(ENGINES)}")
        if self.profile not in PROFILES:
            raise ValueError(f"profile: {self.profile!r} is neither {' nor '.join(PROFILES)}")
        for name in POSITIVE:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: must be positive and finite")
        if not (0 <= self.slip < 1 and 0 <= self.slip_soft < math.inf):
            raise ValueError("slip: must be from 0 to below 1, slip_soft not negative")
        if len(self.start) not in (0, 3) or not np.isfinite(self.start).all():
            raise ValueError("start: must be x, y and heading, or empty")


@dataclass(frozen=True)
class _Fix:
    """A fix in `map` with what the filter needs of it."""

    stamp_ns: int
    receiver: int
    sensor: str
    position_m: Floats
    variance_m2: Floats
    dead: Dead


class Localiser:
    """Fuses GPS, IMUs and wheels over 15 states and the sensors' slow errors; takes readings in nearly any order."""

    def __init__(self, machine: MachineConfig, projection: Projection, config: LocalisationConfig) -> None:
        self.dead = DeadReckoning(machine, config.slip)
        self._config, self._projection = config, projection
        self._own: Counter[str] = Counter()
        self._steps = Steps(machine, config.step_s, orients=config.profile == "paper")
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        self._receivers = [s for s in machine.sensors if s.kind == "gps" and s.use]
        wheels = (s for s in self._sensors.values() if s.kind in ("encoder", "odometry"))
        self._wheel_gate = next((s.gate_sigma for s in wheels), 0.0)  # of the one that dead reckoning uses, the first
        self._imus = [s.name for s in machine.sensors if s.kind == "imu" and s.use]
        augmented = config.profile == "default"
        self._layout = Layout(len(self._imus), True, len(self._receivers)) if augmented else Layout()
        self._errors = [GpsError(MIN_DRIFT_M2, s.drift_time_s) for s in self._receivers] if augmented else []
        self._heard: set[int] = set()
        self._watches = {s.name: Watch() for s in self._receivers}
        self._traction = 0.0
        self._rolling = 0.0  # resistance, low-passed
        self._engine: Filter = ENGINES[config.filter]()
        self._fusion: Fusion | None = None
        self._waiting: deque[Step] = deque(maxlen=COLLECTED)
        self._fixes: deque[_Fix] = deque(maxlen=COLLECTED)
        self._track: deque[Dead] = deque(maxlen=COLLECTED)

    @property
    def is_aligned(self) -> bool:
        """Whether the heading is known."""
        return self._fusion is not None

    @property
    def counters(self) -> Counter[str]:
        """What was used, gated and refused."""
        return self._own + self._steps.counters + (self._fusion.counters if self._fusion else Counter())

    @property
    def consistency(self) -> dict[str, Consistency]:
        """How consistent the filter is with each GPS receiver, of those that were heard enough."""
        found = {name: watch.consistency() for name, watch in self._watches.items()}
        return {name: value for name, value in found.items() if value}

    @property
    def belief(self) -> Belief | None:
        """The whole state, once it is known."""
        return self._fusion.belief if self._fusion else None

    def update(self, reading: Reading, sensor: SensorConfig) -> list[PoseBelief]:
        """Take in one reading; returns beliefs that it made possible or changed, oldest first."""
        if isinstance(reading, Gps):
            return self._take_fix(self._fix(reading))
        self.dead.update(reading, sensor)
        step = self._steps.take(reading, sensor, self.dead)
        if step is None:
            return []
        if self._fusion is None:
            self._waiting.append(step)
            self._track.append(self.dead.now())
            return self._start_as_told() if self._config.start else []
        return self._take_step(self._fusion, step)

    # --- measurements ------------------------------------------------------------------------------------------------

    def _take_step(self, fusion: Fusion, step: Step) -> list[PoseBelief]:
        self._traction = step.traction
        measurements = self._measurements(step)
        return self._poses(fusion.add(measurements) if measurements else [])

    def _measurements(self, step: Step) -> list[Measurement]:
        found = [self._inertial(step, i, name) for i, name in enumerate(self._imus) if name in step.felt]
        if self._config.profile == "paper":  # the default leaves headings aside: near steel they are wrong for minutes
            found += [self._orientation(step, name) for name in step.orientations]
        return found + self._of_wheels(step) if step.rolled else found  # silent ones are not at rest

    def _inertial(self, step: Step, imu: int, name: str) -> Measurement:
        c, felt, sensor = self._config.sensing, step.felt[name], self._sensors[name]
        rate_std = c.rate_radps if sensor.says("rate") else UNKNOWN_STD
        force_std = c.force_mps2 if sensor.says("force") else UNKNOWN_STD
        R = np.diag([rate_std**2] * 3 + [force_std**2] * 3)
        bias = self._layout.gyro_bias(imu) if self._layout.imus else None
        lever, gate = np.array(sensor.mount.xyz_m), sensor.gate_sigma or c.gate_sigma
        return sensing.inertial(step.stamp_ns, name, felt.rates_radps, felt.force_mps2, R, lever, bias, gate)

    def _orientation(self, step: Step, name: str) -> Measurement:
        (rpy, variances), sensor = step.orientations[name], self._sensors[name]
        said = [sensor.says("tilt"), sensor.says("tilt"), sensor.says("heading")]
        R = np.diag(np.where(said, variances, UNKNOWN_STD**2))
        gate = sensor.gate_sigma or self._config.sensing.gate_sigma
        return sensing.orientation(step.stamp_ns, name, rpy, R, gate)

    def _of_wheels(self, step: Step) -> list[Measurement]:
        c, stamp = self._config.sensing, step.stamp_ns
        speed = step.speed_mps * (1 - self._slip(step) * math.copysign(1.0, step.speed_mps))
        R = np.diag([c.speed_mps**2, c.side_mps**2, c.side_mps**2])
        scale = self._layout.wheel_scales.start if self._layout.wheel_scale else None
        found = [
            sensing.wheels(stamp, "wheels", np.array([speed, 0.0, 0.0]), R, scale, self._wheel_gate or c.gate_sigma)
        ]
        if step.still_s >= self._config.standstill_s:
            found.append(sensing.standstill(stamp, c))
        return found

    def _slip(self, step: Step) -> float:
        """Slip of the wheels, from traction and from the part of it that is no climb and no acceleration."""
        if forces := self._forces(step):
            rolling = abs(step.traction - forces[0][0] / GRAVITY_MPS2)
            self._rolling += min(self._config.step_s / ROLLING_S, 1.0) * (rolling - self._rolling)
        return step.traction * (self._config.slip + self._config.slip_soft * self._rolling)

    def _forces(self, step: Step) -> list[Floats]:
        """Specific forces (3,) of the IMUs that measure them."""
        return [felt.force_mps2 for name, felt in step.felt.items() if self._sensors[name].says("force")]

    def _take_fix(self, fix: _Fix) -> list[PoseBelief]:
        if self._fusion is None:
            self._fixes.append(fix)
            return self._try_align()
        return self._poses(self._add_fix(self._fusion, fix))

    def _add_fix(self, fusion: Fusion, fix: _Fix) -> list[Belief]:
        sensor, c = self._receivers[fix.receiver], self._config.sensing
        error, change = None, None
        variance = np.maximum(fix.variance_m2, c.min_fix_std_m**2)
        if self._layout.receivers:
            drift_m2 = max(sensor.drift_share * float(fix.variance_m2.mean()), MIN_DRIFT_M2)
            variance = np.maximum(fix.variance_m2 * (1 - sensor.drift_share), c.min_fix_std_m**2)
            self._errors[fix.receiver] = GpsError(drift_m2, sensor.drift_time_s)
            error = self._layout.gps_error(fix.receiver)
            if fix.receiver not in self._heard:  # a receiver that comes late brings its own unknown error
                change = partial(_renewed, states=error, variance=drift_m2)
        lever = np.array(sensor.mount.xyz_m)
        measurement = sensing.fix(
            fix.stamp_ns,
            fix.sensor,
            fix.position_m,
            np.diag(variance),
            lever,
            error,
            sensor.gate_sigma or c.gps_gate_sigma,
        )
        beliefs = fusion.add([measurement], change)
        if beliefs:
            self._heard.add(fix.receiver)
            self._watches[fix.sensor].note(fusion.last[fix.sensor])
        return beliefs

    def _fix(self, gps: Gps) -> _Fix:
        x, y, _ = self._projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        receiver = next(i for i, s in enumerate(self._receivers) if s.name == gps.sensor)
        variance = np.array([gps.var_e_m2, gps.var_n_m2])
        return _Fix(gps.stamp_ns, receiver, gps.sensor, np.array([x, y]), variance, self.dead.now())

    # --- beliefs -----------------------------------------------------------------------------------------------------

    def _motion(self, belief: Belief, dt_s: float) -> Motion:
        c = self._config
        slip_m2 = c.slip_std**2 * 2 * c.slip_time_s * (self._traction * float(belief.x[SPEED])) ** 2 * dt_s
        return motion(self._layout, c.motion, belief, dt_s, self._errors, slip_m2)

    def _poses(self, beliefs: list[Belief]) -> list[PoseBelief]:
        speed = self.dead.wheels.speed_mps
        return [
            PoseBelief(b.stamp_ns, float(b.x[0]), float(b.x[1]), _wrapped(float(b.x[YAW])), speed, b.P[:2, :2].copy())
            for b in beliefs
        ]

    # --- alignment ---------------------------------------------------------------------------------------------------

    def _try_align(self) -> list[PoseBelief]:
        """Start the filter once the way driven shows the heading, and run it over what was collected."""
        c = self._config
        if self.dead.way_m < c.align_way_m or len(self._fixes) < 4 or not self._track:
            return []
        antennas = np.array([self._dead_antenna(fix) for fix in self._fixes])
        if float(np.sqrt(((antennas - antennas.mean(axis=0)) ** 2).sum(axis=1).mean())) < c.align_spread_m:
            return []
        std = mean_std([float(fix.variance_m2.mean()) for fix in self._fixes])
        found = align(antennas, np.array([fix.position_m for fix in self._fixes]), std)
        return self._start(found, std) if found else []

    def _dead_antenna(self, fix: _Fix) -> tuple[float, float]:
        lever = self._receivers[fix.receiver].mount.xyz_m
        c, s = math.cos(fix.dead.angle_rad), math.sin(fix.dead.angle_rad)
        return fix.dead.x_m + c * lever[0] - s * lever[1], fix.dead.y_m + s * lever[0] + c * lever[1]

    def _start_as_told(self) -> list[PoseBelief]:
        x, y, heading = self._config.start
        dead = self._track[0]
        rotation = heading - dead.angle_rad
        return self._start(Alignment(rotation, TOLD_STD_RAD, (x - dead.x_m, y - dead.y_m)), TOLD_STD_M)

    def _start(self, found: Alignment, fix_std_m: float) -> list[PoseBelief]:
        start = self._start_belief(found, fix_std_m)
        self._fusion = Fusion(self._engine, self._motion, start, self._config.fusion)
        events: list[Step | _Fix] = [*list(self._waiting)[1:], *self._fixes]
        poses = self._poses([start])
        for event in sorted(events, key=lambda e: e.stamp_ns):
            if isinstance(event, Step):
                poses += self._take_step(self._fusion, event)
            else:
                poses += self._poses(self._add_fix(self._fusion, event))
        for collected in (self._waiting, self._fixes, self._track):
            collected.clear()
        return poses

    def _start_belief(self, found: Alignment, fix_std_m: float) -> Belief:
        """Belief at the first step: the fixes are used again by the filter, so the position is left wide."""
        step, dead = self._waiting[0], self._track[0]
        c, s = math.cos(found.rotation_rad), math.sin(found.rotation_rad)
        x, variance = np.zeros(self._layout.n), np.full(self._layout.n, 1e-6)
        x[:2] = found.origin_m + np.array([c * dead.x_m - s * dead.y_m, s * dead.x_m + c * dead.y_m])
        x[YAW] = _wrapped(found.rotation_rad + dead.angle_rad)
        x[SPEED] = step.speed_mps
        if forces := self._forces(step):
            ahead, left, _ = np.mean(forces, axis=0) / GRAVITY_MPS2
            x[ATTITUDE.start], x[ATTITUDE.start + 1] = (
                math.asin(np.clip(left, -0.7, 0.7)),
                -math.asin(np.clip(ahead, -0.7, 0.7)),
            )
        variance[POSITION] = (2 * fix_std_m) ** 2
        variance[ATTITUDE] = 0.1**2
        variance[YAW] = min(0.5, 2 * found.std_rad + 0.05) ** 2
        variance[VELOCITY], variance[RATE], variance[ACCELERATION] = START_MPS**2, 0.1**2, 1.0
        if self._layout.imus:
            variance[self._layout.gyro_biases] = self._config.gyro_bias_radps**2
            variance[self._layout.wheel_scales] = self._config.wheel_scale**2
        return Belief(step.stamp_ns, x, np.diag(variance))


def _renewed(belief: Belief, states: slice, variance: float) -> Belief:
    """The belief with states that nothing is known of."""
    x, P = belief.x.copy(), belief.P.copy()
    x[states], P[states, :], P[:, states] = 0.0, 0.0, 0.0
    P[states, states] = np.eye(states.stop - states.start) * variance
    return Belief(belief.stamp_ns, x, P)


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
