"""The localiser: readings in, beliefs about the pose out. Until it knows its heading it only collects."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace

import numpy as np

from agents.dead_reckoning import Alignment, Dead, DeadReckoning, align, mean_std, turn_source
from agents.localisation import measurements
from agents.localisation.consistency import Consistency
from agents.localisation.filters.belief import Belief, Filter, Measurement, Motion, PoseBelief
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.history import Fusion, FusionConfig
from agents.localisation.filters.motion import MotionConfig, motion
from agents.localisation.filters.state import ACCELERATION, ATTITUDE, POSITION, RATE, SPEED, VELOCITY, YAW, Layout
from agents.localisation.filters.ukf import Ukf
from agents.localisation.gps import Fix, Receivers, drifting
from agents.localisation.headings import UNKNOWN_STD, References, counted_from_start
from agents.localisation.imu_steps import Step, Steps
from agents.localisation.measurements import SensingConfig
from protocol.arrays import Floats
from protocol.config import require_positive
from protocol.machine.machine_config import ABSOLUTE, MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection
from protocol.units import GRAVITY_MPS2

COLLECTED = 24_000  # steps and fixes kept while the heading is unknown: 20 minutes; a machine that waits needs no more
START_MPS = 3.0  # how unsure the first speed is: the machine may drive already, and wheels take a moment to tell
ROLLING_S = 0.5
BEND_S = 60.0  # how long the error of an odometry's turn rate stays the same: a wrong scale makes another in every bend
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
        require_positive(self, POSITIVE)
        if not (0 <= self.slip < 1 and 0 <= self.slip_soft < math.inf):
            raise ValueError("slip: must be from 0 to below 1, slip_soft not negative")
        if len(self.start) not in (0, 3) or not np.isfinite(self.start).all():
            raise ValueError("start: must be x, y and heading, or empty")


class Localiser:
    """Fuses GPS, IMUs and wheels over 15 states and the sensors' slow errors; takes readings in nearly any order."""

    def __init__(self, machine: MachineConfig, projection: Projection, config: LocalisationConfig) -> None:
        self.dead = DeadReckoning(machine, config.slip)
        self._config = config
        self._own: Counter[str] = Counter()
        self._steps = Steps(machine, config.step_s, orients=config.profile == "paper")
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        wheels = [s for s in self._sensors.values() if s.kind in ("encoder", "odometry") and s.says("speed")]
        self._wheels = wheels[0] if wheels else None  # the one that dead reckoning uses, the first
        self._imus = [s.name for s in machine.sensors if s.kind == "imu" and s.use]
        self._turns = turn_source(machine)
        augmented = config.profile == "default"
        self._layout = _layout(machine, len(self._imus)) if augmented else Layout()
        self._receivers = Receivers(machine.sensors, projection, self._layout, config.sensing, slow=augmented)
        self._references = References(machine.sensors, self._layout, config.sensing)
        is_flat = not any(_shows_tilt(s, config.profile) for s in machine.sensors)
        self._moves = replace(config.motion, two_d=True) if is_flat else config.motion
        self._traction = 0.0
        self._rolling = 0.0  # resistance, low-passed
        self._engine: Filter = ENGINES[config.filter]()
        self._fusion: Fusion | None = None
        self._waiting: deque[Step] = deque(maxlen=COLLECTED)
        self._fixes: deque[Fix] = deque(maxlen=COLLECTED)
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
        return self._receivers.consistency

    @property
    def belief(self) -> Belief | None:
        """The whole state, once it is known."""
        return self._fusion.belief if self._fusion else None

    def update(self, reading: Reading, sensor: SensorConfig) -> list[PoseBelief]:
        """Take in one reading; returns beliefs that it made possible or changed, oldest first."""
        if isinstance(reading, Gps):
            return self._take_fix(self._receivers.fix(reading, self.dead.now()))
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
        beliefs = self._references.add(fusion, step)
        measurements = self._measurements(step)
        return self._poses(beliefs + (fusion.add(measurements) if measurements else []))

    def _measurements(self, step: Step) -> list[Measurement]:
        found = [self._inertial(step, i, name) for i, name in enumerate(self._imus) if name in step.felt]
        found += self._references.measurements(step) + self._of_turn(step)
        return found + self._of_wheels(step) if step.rolled else found  # silent ones are not at rest

    def _inertial(self, step: Step, imu: int, name: str) -> Measurement:
        c, felt, sensor = self._config.sensing, step.felt[name], self._sensors[name]
        rate_std = sensor.std.get("rate", c.rate_radps) if sensor.says("rate") else UNKNOWN_STD
        force_std = sensor.std.get("force", c.force_mps2) if sensor.says("force") else UNKNOWN_STD
        R = np.diag([rate_std**2] * 3 + [force_std**2] * 3)
        bias = self._layout.gyro_bias(imu) if self._layout.imus else None
        lever, gate = np.array(sensor.mount.xyz_m), sensor.gate_sigma or c.gate_sigma
        return measurements.inertial(step.stamp_ns, name, felt.rates_radps, felt.force_mps2, R, lever, bias, gate)

    def _of_turn(self, step: Step) -> list[Measurement]:
        """The turn rate where no IMU tells it. Where nothing does, it shows only in the fixes and is very unsure."""
        if self._turns is None:
            self._own["turn_unknown"] += 1
        if self._turns is None or step.turn is None:
            return []
        std, told = _turn_std(self._turns, self._config.sensing), step.turn
        error = self._layout.gyro_bias(len(self._imus)) if self._layout.imus else None
        gate = self._turns.gate_sigma or self._config.sensing.gate_sigma
        return [measurements.turn(step.stamp_ns, told.rate_radps, std, error, told.per_error, gate)]

    def _of_wheels(self, step: Step) -> list[Measurement]:
        c, stamp = self._config.sensing, step.stamp_ns
        assert self._wheels is not None  # as step.rolled
        speed = step.speed_mps * (1 - self._slip(step) * math.copysign(1.0, step.speed_mps))
        R = np.diag([self._wheels.std.get("speed", c.speed_mps) ** 2, c.side_mps**2, c.side_mps**2])
        scale = self._layout.wheel_scales.start if self._layout.wheel_scale else None
        gate = self._wheels.gate_sigma or c.gate_sigma
        found = [measurements.wheels(stamp, "wheels", np.array([speed, 0.0, 0.0]), R, scale, gate)]
        if step.still_s >= self._config.standstill_s:
            found.append(measurements.standstill(stamp, c))
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

    def _take_fix(self, fix: Fix) -> list[PoseBelief]:
        if self._fusion is None:
            self._fixes.append(fix)
            return self._try_align()
        return self._poses(self._receivers.add(self._fusion, fix))

    # --- beliefs -----------------------------------------------------------------------------------------------------

    def _motion(self, belief: Belief, dt_s: float) -> Motion:
        c = self._config
        slip_m2 = c.slip_std**2 * 2 * c.slip_time_s * (self._traction * float(belief.x[SPEED])) ** 2 * dt_s
        found = motion(self._layout, self._moves, belief, dt_s, self._receivers.errors, slip_m2)
        wander = self._layout.heading_errors  # as our own heading does
        found.Q[wander, wander] = np.eye(self._layout.references) * (c.motion.heading_walk**2 * dt_s)
        if self._layout.imus and self._turns and self._turns.kind == "odometry":
            error = self._layout.gyro_bias(len(self._imus))
            found.Q[error, error] += 2 * _turn_std(self._turns, c.sensing) ** 2 * dt_s / BEND_S
        return found

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
        fixes = [fix for fix in self._fixes if fix.is_absolute]
        if len(fixes) < 4:
            return []
        antennas = np.array([_dead_antenna(fix) for fix in fixes])
        if float(np.sqrt(((antennas - antennas.mean(axis=0)) ** 2).sum(axis=1).mean())) < c.align_spread_m:
            return []
        std = mean_std([float(fix.variance_m2.mean()) for fix in fixes])
        found = align(antennas, np.array([fix.position_m for fix in fixes]), std)
        return self._start(found, std) if found else []

    def _start_as_told(self) -> list[PoseBelief]:
        x, y, heading = self._config.start
        dead = self._track[0]
        rotation = heading - dead.angle_rad
        return self._start(Alignment(rotation, TOLD_STD_RAD, (x - dead.x_m, y - dead.y_m)), TOLD_STD_M)

    def _start(self, found: Alignment, fix_std_m: float) -> list[PoseBelief]:
        start = self._start_belief(found, fix_std_m)
        self._fusion = Fusion(self._engine, self._motion, start, self._config.fusion)
        events: list[Step | Fix] = [*list(self._waiting)[1:], *self._fixes]
        poses = self._poses([start])
        for event in sorted(events, key=lambda e: e.stamp_ns):
            if isinstance(event, Step):
                poses += self._take_step(self._fusion, event)
            else:
                poses += self._poses(self._receivers.add(self._fusion, event))
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
        variance[self._layout.gyro_biases] = self._config.gyro_bias_radps**2
        variance[self._layout.wheel_scales] = self._config.wheel_scale**2
        if self._turns and self._layout.imus > len(self._imus):
            variance[self._layout.gyro_bias(len(self._imus))] = _turn_std(self._turns, self._config.sensing) ** 2
        return Belief(step.stamp_ns, x, np.diag(variance))


def _layout(machine: MachineConfig, imus: int) -> Layout:
    """States for the slow errors of a machine's sensors."""
    source = turn_source(machine)
    rates = imus + (source is not None and source.kind != "imu")
    return Layout(rates, True, len(drifting(machine.sensors)), len(counted_from_start(machine.sensors)))


def _shows_tilt(sensor: SensorConfig, profile: str) -> bool:
    """Whether a sensor tells roll and pitch, or how they change; a machine without any is taken to be on a plane."""
    oriented = sensor.kind == "attitude" and sensor.says("tilt") and (profile == "paper" or sensor.mode != ABSOLUTE)
    return sensor.use and (sensor.kind == "imu" or oriented)


def _turn_std(source: SensorConfig, config: SensingConfig) -> float:
    return source.std.get("rate", config.turn_radps)


def _dead_antenna(fix: Fix) -> tuple[float, float]:
    lever = fix.sensor.mount.xyz_m
    c, s = math.cos(fix.dead.angle_rad), math.sin(fix.dead.angle_rad)
    return fix.dead.x_m + c * lever[0] - s * lever[1], fix.dead.y_m + s * lever[0] + c * lever[1]


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
