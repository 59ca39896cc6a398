"""IMUs, wheels, and what else shows the turn: from filter steps to measurements of the body's motion.

Driven wheels turn further than the machine moves, by a share that grows with traction.

    slip = traction (s0 + s1 rolling)        machine speed = wheel speed (1 - slip sign(speed))

traction: drive force over weight, signed ahead. rolling: the part of it that neither climbs nor accelerates, which an
accelerometer ahead measures together. s0, s1: `slip` and `slip_soft` of the tyres; soft ground resists, and gives way.
"""

import math
from collections import Counter

import numpy as np

from agents.dead_reckoning import turn_source
from agents.localisation import measurements
from agents.localisation.filters.belief import Measurement
from agents.localisation.filters.state import Layout
from agents.localisation.headings import UNKNOWN_STD
from agents.localisation.imu_steps import FilterStep
from agents.localisation.measurements import GATE_SIGMA
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.units import GRAVITY_MPS2

STANDSTILL_S = 1.0  # after so long without travel the machine stands; coarse ticks of one that crawls come sooner
ROLLING_S = 0.5  # time constant of the low-pass on the rolling resistance


class MotionSensors:
    """The motion sensors of one machine; step_s: length of a filter step.

    slip, slip_soft: of the tyres.
    """

    def __init__(self, machine: MachineConfig, layout: Layout, step_s: float, slip: float, slip_soft: float) -> None:
        self.counters: Counter[str] = Counter()
        self._layout, self._step_s = layout, step_s
        self._slip, self._slip_soft, self._rolling = slip, slip_soft, 0.0
        used = [s for s in machine.sensors if s.use]
        self._imus = {s.name: s for s in used if s.kind == "imu"}
        wheels = [s for s in used if s.kind in ("encoder", "odometry") and s.provides("speed")]
        self._wheels = wheels[0] if wheels else None  # the one that dead reckoning uses, the first
        self._turn_sensor = turn_source(machine)

    @property
    def turn_error_radps(self) -> float:
        """Standard deviation of the lasting error of the turn, 0 where IMUs measure it or nothing does."""
        source = self._turn_sensor
        return _turn_std(source) if source and source.kind != "imu" else 0.0

    def forces(self, step: FilterStep) -> list[Floats]:
        """Specific forces (3,) of the IMUs that measure them."""
        return [mean.force_mps2 for name, mean in step.imu_means.items() if self._imus[name].provides("force")]

    def inertial(self, step: FilterStep) -> list[Measurement]:
        """One measurement per IMU with readings in the step."""
        imus = enumerate(self._imus.values())
        return [self._inertial(step, i, sensor) for i, sensor in imus if sensor.name in step.imu_means]

    def turn(self, step: FilterStep) -> list[Measurement]:
        """The turn rate where no IMU measures it. Where nothing does, it shows in fixes alone and is very unsure."""
        source, layout = self._turn_sensor, self._layout
        if source is None:
            self.counters["turn_unknown"] += 1
        if source is None or step.turn is None:
            return []
        error = layout.gyro_biases.stop - 1 if layout.imus else None
        rate, per_error = step.turn.rate_radps, step.turn.per_error
        std, gate = _turn_std(source), source.gate(GATE_SIGMA)
        return [measurements.turn(step.stamp_ns, rate, std, error, per_error, gate)]

    def wheels(self, step: FilterStep) -> list[Measurement]:
        """Speed of the wheels less their slip, and a standstill; nothing of wheels that are silent, not at rest."""
        if not step.rolled or self._wheels is None:
            return []
        if forces := self.forces(step):
            self._rolling = rolling_resistance(self._rolling, step.traction, float(forces[0][0]), self._step_s)
        speed = machine_speed(step.speed_mps, step.traction, self._slip + self._slip_soft * self._rolling)
        forward_std, side_std = self._wheels.std.get("speed", measurements.SPEED_MPS), measurements.SIDE_MPS
        R = np.diag([forward_std**2, side_std**2, side_std**2])
        scale = self._layout.wheel_scales.start if self._layout.wheel_scale else None
        z, gate = np.array([speed, 0.0, 0.0]), self._wheels.gate(GATE_SIGMA)
        rolled = measurements.wheels(step.stamp_ns, "wheels", z, R, scale, gate)
        return [rolled, measurements.standstill(step.stamp_ns)] if step.still_s >= STANDSTILL_S else [rolled]

    def _inertial(self, step: FilterStep, index: int, sensor: SensorConfig) -> Measurement:
        mean = step.imu_means[sensor.name]
        rate_std = sensor.std.get("rate", measurements.RATE_RADPS) if sensor.provides("rate") else UNKNOWN_STD
        force_std = sensor.std.get("force", measurements.FORCE_MPS2) if sensor.provides("force") else UNKNOWN_STD
        z, R = np.concatenate([mean.rates_radps, mean.force_mps2]), np.diag([rate_std**2] * 3 + [force_std**2] * 3)
        bias = self._layout.gyro_bias(index) if self._layout.imus else None
        lever = np.array(sensor.mount.xyz_m)
        return measurements.inertial(step.stamp_ns, sensor.name, z, R, lever, bias, sensor.gate(GATE_SIGMA))


def rolling_resistance(before: float, traction: float, force_ahead_mps2: float, dt_s: float) -> float:
    """Rolling resistance over weight [-], low-passed from the one before; force_ahead_mps2: of the accelerometer."""
    rolling = abs(traction - force_ahead_mps2 / GRAVITY_MPS2)
    return before + min(dt_s / ROLLING_S, 1.0) * (rolling - before)


def machine_speed(wheel_mps: float, traction: float, slip_per_traction: float) -> float:
    """Speed of a machine [m/s] from that of its wheels."""
    return wheel_mps * (1 - traction * slip_per_traction * math.copysign(1.0, wheel_mps))


def _turn_std(source: SensorConfig) -> float:
    return source.std.get("rate", measurements.TURN_RADPS)
