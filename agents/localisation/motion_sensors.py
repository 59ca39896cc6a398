"""IMUs, wheels and turn sensors: filter steps to measurements of body motion.

Driven wheels turn further than the machine moves, in proportion to traction:

    slip = traction (s0 + s1 rolling)        machine speed = wheel speed (1 - slip sign(speed))

traction: drive force over weight, signed ahead. rolling: its part that neither climbs nor accelerates, by an
accelerometer ahead. s0, s1: `slip`, `slip_soft` of the tyres; soft ground resists and yields. An unweighed load makes
traction and slip seem larger.
"""

import math
from collections import Counter

import numpy as np

from agents.dead_reckoning import LOADING_S, turn_source
from agents.localisation import measurements
from agents.localisation.filters.belief import Measurement
from agents.localisation.filters.state import Layout
from agents.localisation.headings import UNKNOWN_STD
from agents.localisation.imu_steps import FilterStep, Turn
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, BASE, DIFFERENTIAL, RELATIVE, MachineConfig, SensorConfig
from protocol.units import GRAVITY_MPS2

STANDSTILL_S = 1.0  # time without travel that is standstill; slow ticks come sooner
REST_S = 2.0  # the same without speeds over ground, about one a second


class MotionSensors:
    """One machine's motion sensors.

    step_s: of a filter step. tyres: `slip`, `slip_soft`. on_plane: tilt is no state, so an IMU measures the turn only.
    is_weighed: the load is known. slip_std: of slip per traction, newest step.
    """

    def __init__(
        self,
        machine: MachineConfig,
        layout: Layout,
        step_s: float,
        tyres: tuple[float, float],
        *,
        on_plane: bool,
        is_weighed: bool = True,
        tuning: LocalisationTuning = TUNING,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.slip_std, self._is_weighed, self._tuning = tuning.slip_std, is_weighed, tuning
        self._load_doubt = 0.0
        self._layout, self._step_s, self._on_plane = layout, step_s, on_plane
        (self._slip, self._slip_soft), self._rolling = tyres, 0.0
        used = [s for s in machine.sensors if s.use]
        self._imus = {s.name: s for s in used if s.kind == "imu"}
        self._whole = {s.name: self._whole_imu(i, s) for i, s in enumerate(self._imus.values())}
        self._wheels = [s for s in used if s.kind in ("encoder", "odometry") and s.provides("speed")]
        # They slip together: the mean is as uncertain as the worst.
        forward_std = max((s.std.get("speed", tuning.speed_mps) for s in self._wheels), default=0.0)
        self._wheels_R = np.diag([forward_std**2, tuning.side_mps**2, tuning.side_mps**2])
        self._wheels_gate = max((s.gate(tuning.gate_sigma) for s in self._wheels), default=0.0)
        self._turn_sensor = turn_source(machine)
        self._turned_ns, self._wheelbase_m = 0, machine.wheelbase_m

    @property
    def turn_error_radps(self) -> float:
        """Deviation of the lasting turn error; 0 if IMUs or nothing measure the turn."""
        source = self._turn_sensor
        return self._turn_std(source) if source and source.kind != "imu" else 0.0

    def forces(self, step: FilterStep) -> list[Floats]:
        """Specific forces (3,) of IMUs that measure them."""
        return [mean.force_mps2 for name, mean in step.imu_means.items() if self._imus[name].provides("force")]

    def inertial(self, step: FilterStep) -> list[Measurement]:
        """A measurement per IMU with usable readings in the step."""
        means = step.imu_means
        if self._on_plane:
            imus = [(i, s) for i, s in enumerate(self._imus.values()) if s.name in means and s.provides("rate")]
            return [self._yaw_rate(step, i, sensor) for i, sensor in imus]
        present = ((model, means[name]) for name, model in self._whole.items() if name in means)
        return [m.at(step.stamp_ns, np.concatenate([mean.rates_radps, mean.force_mps2])) for m, mean in present]

    def turn(self, step: FilterStep) -> list[Measurement]:
        """The turn rate where no IMU measures it; without any sensor, fixes alone show it, poorly."""
        source, layout = self._turn_sensor, self._layout
        if source is None:
            self.counters["turn_unknown"] += 1
        if source is None or step.turn is None:
            return []
        error = layout.gyro_biases.stop - 1 if layout.imus else None
        rate, per_error, gate = step.turn.rate_radps, step.turn.per_error, source.gate(self._tuning.gate_sigma)
        dt_s, self._turned_ns = (step.stamp_ns - self._turned_ns) * 1e-9, step.stamp_ns
        std = self._steered_std(source, step.turn, dt_s) if source.kind == "steering" else self._turn_std(source)
        return [measurements.turn(step.stamp_ns, "turn", rate, std, error, per_error, gate)]

    def _steered_std(self, source: SensorConfig, turn: Turn, dt_s: float) -> float:
        """Standard deviation of a steered rate, dt_s after the last: white noise, and the angle's error.

        The latter is e v / (L cos^2 angle), v the speed, L the wheelbase, and lasts steered_s. Equivalent white noise
        has 2 steered_s / dt times its variance.
        """
        speed = turn.per_error
        tangent = self._wheelbase_m * turn.rate_radps / speed if speed else 0.0
        std = source.std.get("angle", self._tuning.steering_rad) * speed / self._wheelbase_m * (1 + tangent**2)
        return math.hypot(self._tuning.rate_radps, std * math.sqrt(max(2 * self._tuning.steered_s / dt_s, 1.0)))

    def wheels(self, step: FilterStep, considers: tuple[int, ...] = ()) -> list[Measurement]:
        """Wheel speed less slip, and standstill; if silent, what holds without wheels.

        considers: states that the speed leaves unchanged; a standstill updates them.
        """
        folds = abs(step.joint_radps) > self._tuning.joint_radps  # at standstill the joint turns both frames
        if step.silent:
            still = [measurements.rest(step.stamp_ns, self._tuning)] if step.still_s >= REST_S and not folds else []
            return [measurements.sides(step.stamp_ns, considers, self._tuning), *still]
        if not step.rolled or not self._wheels:
            return []
        if forces := self.forces(step):
            ahead = sum(float(force[0]) for force in forces) / len(forces)
            share = min(self._step_s / self._tuning.rolling_s, 1.0)
            self._rolling = rolling_resistance(self._rolling, step.traction, ahead, share)
        slip = self._slip + self._slip_soft * self._rolling
        if not self._is_weighed:
            self._doubt_load(step.still_s)
        self.slip_std = math.hypot(self._tuning.slip_std, self._load_doubt * slip)
        z = np.array([machine_speed(step.wheels.speed_mps, step.traction, slip), 0.0, 0.0])
        scale = self._layout.wheel_scales.start if self._layout.wheel_scale else None
        R, gate, offset_m = self._wheels_R, self._wheels_gate, step.wheels.offset_m
        rolled = measurements.wheels(step.stamp_ns, "wheels", z, R, scale, gate, offset_m, considers)
        if step.still_s < STANDSTILL_S:
            return [rolled]
        return [rolled, measurements.standstill(step.stamp_ns, self._tuning, turns=folds)]

    def _doubt_load(self, still_s: float) -> None:
        if still_s >= LOADING_S:
            self._load_doubt = self._tuning.load_doubt

    def _whole_imu(self, index: int, sensor: SensorConfig) -> Measurement:
        rate_std = self._gyro_std(sensor) if sensor.provides("rate") else UNKNOWN_STD
        force_std = sensor.std.get("force", self._tuning.force_mps2) if sensor.provides("force") else UNKNOWN_STD
        R, lever = np.diag([rate_std**2] * 3 + [force_std**2] * 3), np.array(sensor.mount.xyz_m)
        gate = sensor.gate(self._tuning.gate_sigma)
        return measurements.inertial(0, sensor.name, np.zeros(6), R, lever, self._bias(index), gate)

    def _yaw_rate(self, step: FilterStep, index: int, sensor: SensorConfig) -> Measurement:
        rate, gate = float(step.imu_means[sensor.name].rates_radps[2]), sensor.gate(self._tuning.gate_sigma)
        return measurements.turn(step.stamp_ns, sensor.name, rate, self._gyro_std(sensor), self._bias(index), 1.0, gate)

    def _bias(self, index: int) -> int | None:
        return self._layout.gyro_bias(index) if self._layout.imus else None

    def _gyro_std(self, imu: SensorConfig) -> float:
        return imu.std.get("rate", self._tuning.rate_radps)

    def _turn_std(self, source: SensorConfig) -> float:
        """Deviation of odometry's rate and lasting error; of steering, the latter."""
        return source.std.get("rate", self._tuning.turn_radps)


def shows_tilt(machine: MachineConfig, profile: str) -> bool:
    """Whether the sensors show roll and pitch; else the machine counts as on a plane.

    By an attitude reference that the profile uses, or by gravity between turn rates. Rates alone show only changes of
    tilt, never corrected; a force alone mixes tilt and acceleration.
    """
    used = [s for s in machine.sensors if s.use]
    bends = any(s.kind == "articulation" for s in used)
    imus = [s for s in used if s.kind == "imu" and (s.frame == BASE or bends)]
    references = [s for s in used if s.kind == "attitude" and s.frame == BASE and s.provides("tilt")]
    modes = (ABSOLUTE, RELATIVE) if profile == "paper" else (RELATIVE,)
    if any(s.mode in modes for s in references):
        return True
    turns = any(s.provides("rate") for s in imus) or any(s.mode == DIFFERENTIAL for s in references)
    return turns and any(s.provides("force") for s in imus)


def rolling_resistance(before: float, traction: float, force_ahead_mps2: float, share: float) -> float:
    """Rolling resistance over weight [-], low-passed; force_ahead_mps2: by the accelerometer."""
    rolling = abs(traction - force_ahead_mps2 / GRAVITY_MPS2)
    return before + share * (rolling - before)


def machine_speed(wheel_mps: float, traction: float, slip_per_traction: float) -> float:
    """Machine speed [m/s] from wheel speed."""
    return wheel_mps * (1 - traction * slip_per_traction * math.copysign(1.0, wheel_mps))
