"""Fast readings gathered into filter steps: IMU means in `base_link`, wheel speed at the end."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.dead_reckoning import (
    PAUSE_NS,
    SILENT_NS,
    DeadReckonedPose,
    DeadReckoning,
    WheelSpeed,
    WheelTracker,
    narrowing,
    turn_source,
)
from protocol.arrays import Floats
from protocol.machine.machine_config import FRONT, MachineConfig, SensorConfig
from protocol.machine.readings import (
    Articulation,
    Attitude,
    Gps,
    GpsVelocity,
    Imu,
    Odometry,
    Reading,
    Steering,
    WheelReading,
)

Sensed = tuple[Reading, SensorConfig]
PLACES = (Gps, GpsVelocity)
NOTHING = (0.0,) * 7  # count and sums
MIN_NORM = 0.5  # an unsettled reference sends a zero quaternion
JOINT_RATE_S = 1.0  # time constant of a slow joint rate: 0.06 deg/s of noise where the angle has 0.2 degrees at 20 Hz


@dataclass(frozen=True)
class ImuMean:
    """An IMU's mean angular rate and specific force over a step, (3,) each, in `base_link`."""

    rates_radps: Floats
    force_mps2: Floats


@dataclass(frozen=True)
class Turn:
    """Mean turn rate [rad/s] over a step, by odometry or steering.

    per_error: effect of the sensor's lasting error: 1 for odometry (a rate); the speed for steering (a curvature
    [1/m]).
    """

    rate_radps: float
    per_error: float


@dataclass(frozen=True)
class FilterStep:
    """Fast readings since the last step.

    reckoned: dead-reckoned pose at its end. attitudes: last usable one per reference. wheels: speed at its end, over
    ground while silent. rolled: wheels were read and show a speed. traction: drive force over weight; still_s: time
    without travel. turn: without IMU. silent: wheels are missing or long silent. joint_radps: articulation rate,
    low-passed, 0 if unknown.
    """

    stamp_ns: int
    reckoned: DeadReckonedPose
    imu_means: dict[str, ImuMean]
    attitudes: dict[str, Attitude]
    wheels: WheelSpeed
    rolled: bool
    traction: float
    still_s: float
    turn: Turn | None = None
    silent: bool = False
    joint_radps: float = 0.0


class StepGatherer:
    """Gathers readings into steps of step_s."""

    def __init__(self, machine: MachineConfig, step_s: float) -> None:
        self.counters: Counter[str] = Counter()
        self._step_ns = round(step_s * 1e9)
        self._rotations = {s.name: s.mount.frame_from_sensor() for s in machine.sensors}  # into base_link or front_link
        self._front = {s.name for s in machine.sensors if s.frame == FRONT}
        self._sums: dict[str, tuple[float, ...]] = {}
        self._attitudes: dict[str, Attitude] = {}
        source = turn_source(machine)
        self._turn_sensor = source.name if source else ""
        self._steers = source is not None and source.kind == "steering"
        self._wheelbase_m = machine.wheelbase_m
        self._turn_values: list[float] = []  # odometry rates, or steering curvatures
        self._begin_ns = 0
        self._sensed_ns = 0
        self._joint = WheelTracker()  # low-passed articulation angle
        self._slow_joint, self._joint_ns = WheelTracker(JOINT_RATE_S), 0
        self._rolled = False

    def gather(self, readings: Sequence[Sensed], dead_reckoning: DeadReckoning) -> FilterStep | None:
        """Add one stamp's readings, after dead reckoning; returns the step they complete.

        GPS readings complete one only after long silence of other sensors.
        """
        stamp_ns = readings[0][0].stamp_ns
        is_sensed = False
        for reading, sensor in readings:
            if not isinstance(reading, PLACES):
                self._add(reading, sensor)
                is_sensed = True
        if is_sensed or not self._sensed_ns:
            self._sensed_ns = stamp_ns
        if not is_sensed and stamp_ns - self._sensed_ns <= SILENT_NS:
            return None
        self._begin_ns = self._begin_ns or stamp_ns
        return self._finish(stamp_ns, dead_reckoning) if stamp_ns - self._begin_ns >= self._step_ns else None

    def _add(self, reading: Reading, sensor: SensorConfig) -> None:
        if isinstance(reading, Imu):
            self._add_imu(reading, sensor)
        elif isinstance(reading, Articulation):
            self._joint.update(reading.stamp_ns, reading.angle_rad)
            self._slow_joint.update(reading.stamp_ns, reading.angle_rad)
            self._joint_ns = reading.stamp_ns
        elif isinstance(reading, Attitude):
            self._add_attitude(reading, sensor)
        elif isinstance(reading, Steering) and sensor.name == self._turn_sensor:
            self._turn_values.append(math.tan(reading.angle_rad) / self._wheelbase_m)
        elif isinstance(reading, WheelReading):
            self._add_wheels(reading, sensor)

    def _add_wheels(self, reading: WheelReading, sensor: SensorConfig) -> None:
        if sensor.provides("speed"):
            self._rolled = True
        if isinstance(reading, Odometry) and sensor.name == self._turn_sensor:
            self._turn_values.append(reading.rate_z_radps)

    def _add_imu(self, imu: Imu, sensor: SensorConfig) -> None:
        """Sum in sensor axes; turning is linear, so the mean is turned once per step."""
        if sensor.frame == FRONT and not self._joint.is_settled:
            self.counters["front_imu_without_articulation"] += 1
            return
        n, wx, wy, wz, fx, fy, fz = self._sums.get(imu.sensor, NOTHING)
        self._sums[imu.sensor] = (
            n + 1,
            wx + imu.gyro_x_radps,
            wy + imu.gyro_y_radps,
            wz + imu.gyro_z_radps,
            fx + imu.force_x_mps2,
            fy + imu.force_y_mps2,
            fz + imu.force_z_mps2,
        )

    def _mean(self, name: str) -> ImuMean:
        n, *total = self._sums[name]
        frame_from_sensor = self._rotations[name]
        rates, force = (np.array(total).reshape(2, 3) / n).dot(frame_from_sensor.T)
        return ImuMean(*(self._to_base(rates, force) if name in self._front else (rates, force)))

    def _add_attitude(self, attitude: Attitude, sensor: SensorConfig) -> None:
        """Keep a usable orientation; the front frame's is not."""
        if sensor.frame == FRONT:
            self.counters["front_attitude_unused"] += 1
        elif math.hypot(attitude.qx, attitude.qy, attitude.qz, attitude.qw) < MIN_NORM:
            self.counters["attitude_without_direction"] += 1
        else:
            self._attitudes[attitude.sensor] = attitude

    def _to_base(self, rates: Floats, force: Floats) -> tuple[Floats, Floats]:
        """Front-frame values in `base_link`: turned by the mid-step articulation, less its rate."""
        angle = self._joint.travel_m - 0.5e-9 * self._step_ns * self._joint.speed_mps
        c, s = math.cos(angle), math.sin(angle)
        base_from_front = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rates = base_from_front @ rates
        rates[2] -= self._joint.speed_mps
        return rates, base_from_front @ force

    def _finish(self, stamp_ns: int, dead_reckoning: DeadReckoning) -> FilterStep:
        imu_means = {name: self._mean(name) for name in self._sums}
        attitudes, self._attitudes = self._attitudes, {}
        self._sums.clear()
        self._begin_ns = stamp_ns
        wheels, silent = dead_reckoning.motion(stamp_ns), dead_reckoning.is_silent(stamp_ns)
        rolled, self._rolled = self._rolled and wheels.is_known and not silent, False
        turn = self._turn(wheels) if self._turn_values else None
        reckoned, traction, still_s = dead_reckoning.pose, dead_reckoning.traction, dead_reckoning.still_s(stamp_ns)
        joint_radps = self._slow_joint.speed_mps if stamp_ns - self._joint_ns <= PAUSE_NS else 0.0
        return FilterStep(
            stamp_ns, reckoned, imu_means, attitudes, wheels, rolled, traction, still_s, turn, silent, joint_radps
        )

    def _turn(self, wheels: WheelSpeed) -> Turn | None:
        """By this step's readings; steering needs a speed."""
        values, self._turn_values = self._turn_values, []
        mean = sum(values) / len(values)
        if not self._steers:
            return Turn(mean, 1.0)
        if not wheels.is_known:
            return None
        speed_mps = wheels.speed_mps / narrowing(mean, wheels.offset_m)
        return Turn(speed_mps * mean, speed_mps)
