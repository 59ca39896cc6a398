"""Dead reckoning: distance, turn and speed of a machine from its wheels and gyro."""

import math
from dataclasses import dataclass

from protocol.arrays import Floats
from protocol.machine.machine_config import BASE, MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Imu, Odometry, Reading, Steering, Torque
from protocol.units import GRAVITY_MPS2

TURN_KINDS = ("imu", "odometry", "steering")  # sensors that show the turn, the best first
STALE_S = 2.0  # an older steering angle, or an older speed to go with it, is not used
MAX_TRACTION = 1.0  # no tyre on any ground drives with more than its load: a wrong unit must not move the machine
MAX_WHEEL_MPS = 30.0  # ticks that come faster are a counter that was set back, not a machine that moves


def turn_source(machine: MachineConfig) -> SensorConfig | None:
    """The sensor that the turn is taken from: an IMU in use that measures rates, else odometry, else steering."""
    able = [s for kind in TURN_KINDS for s in machine.sensors if s.kind == kind and s.use and s.provides("rate")]
    return able[0] if able else None


class WheelTracker:
    """Speed and acceleration from quantised wheel travel: a fading-memory filter of third order.

    Least squares of a parabola over the past, with weights that fade by exp(-dt / tau_s) (Morrison 1969): stable at
    any rate, and without lasting error while the acceleration is constant.
    """

    def __init__(self, tau_s: float = 0.15) -> None:
        self.speed_mps = 0.0
        self.accel_mps2 = 0.0
        self._tau_s = tau_s
        self.travel_m = 0.0
        self._stamp_ns = 0

    def update(self, stamp_ns: int, travel_m: float) -> None:
        """Take in the wheel travel so far."""
        dt = (stamp_ns - self._stamp_ns) * 1e-9
        if not self._stamp_ns or dt > 1:  # the first, or a pause: start from here
            self.travel_m, self._stamp_ns = travel_m, stamp_ns
            return
        if dt <= 0:
            return
        fade = math.exp(-dt / self._tau_s)
        self.travel_m += dt * (self.speed_mps + 0.5 * self.accel_mps2 * dt)
        self.speed_mps += dt * self.accel_mps2
        error = travel_m - self.travel_m
        self.travel_m += (1 - fade**3) * error
        self.speed_mps += 1.5 * (1 - fade) ** 2 * (1 + fade) * error / dt
        self.accel_mps2 += (1 - fade) ** 3 * error / dt**2
        self._stamp_ns = stamp_ns


@dataclass(frozen=True)
class DeadReckonedPose:
    """Pose in the frame that dead reckoning started in: travel [m], angle [rad], x, y [m] at a stamp."""

    stamp_ns: int
    travel_m: float
    angle_rad: float
    x_m: float
    y_m: float


class DeadReckoning:
    """Accumulates wheel travel and turn, without GPS.

    slip: wheel slip per traction (drive force over weight), taken off where the machine has a torque sensor. travel_m:
    of the machine, down in reverse; distance_m: up in reverse too. traction: the newest.
    """

    def __init__(self, machine: MachineConfig, slip: float) -> None:
        self.wheels = WheelTracker()
        self.stamp_ns = 0
        self.travel_m = 0.0
        self.angle_rad = 0.0
        self.distance_m = 0.0
        self._machine = machine
        self._slip = slip
        self.traction = 0.0
        self._rolled_m = 0.0
        self._rotation: dict[str, Floats] = {}
        self._imu: Imu | None = None
        source = turn_source(machine)
        self._turn_sensor = source.name if source else ""
        self._turned_ns = 0  # by odometry or steering
        self._curvature = 0.0  # [1/m], by steering
        self._wheel_reading: Encoder | Odometry | None = None
        self._x_m = 0.0
        self._y_m = 0.0

    def update(self, reading: Reading, sensor: SensorConfig) -> None:
        """Take in a reading of the wheels, or of the sensor that shows the turn; others change nothing."""
        if isinstance(reading, Imu) and sensor.frame == BASE and sensor.provides("rate"):
            self._turn(reading, sensor)
        elif isinstance(reading, Encoder | Odometry):
            if isinstance(reading, Odometry) and sensor.name == self._turn_sensor:
                self._turn_by_odometry(reading)
            if sensor.provides("speed"):
                self._roll(reading, sensor)
        elif isinstance(reading, Steering) and sensor.name == self._turn_sensor:
            self._curvature = math.tan(reading.angle_rad) / self._machine.wheelbase_m
            self._turned_ns = reading.stamp_ns
        elif isinstance(reading, Torque):
            weight_n = self._machine.mass_kg * GRAVITY_MPS2
            traction = reading.torque_nm / self._machine.wheel_radius_m / weight_n
            self.traction = traction if abs(traction) <= MAX_TRACTION else 0.0

    @property
    def pose(self) -> DeadReckonedPose:
        """The newest pose."""
        return DeadReckonedPose(self.stamp_ns, self.travel_m, self.angle_rad, self._x_m, self._y_m)

    def _turn(self, imu: Imu, sensor: SensorConfig) -> None:
        """Integrate the vertical rate of the first gyro on the rear frame."""
        if self._imu is not None and self._imu.sensor != imu.sensor:
            return
        if imu.sensor not in self._rotation:
            self._rotation[imu.sensor] = sensor.mount.frame_from_sensor()
        up = self._rotation[imu.sensor][2]
        if self._imu is not None:
            dt = (imu.stamp_ns - self._imu.stamp_ns) * 1e-9
            rate = up[0] * imu.gyro_x_radps + up[1] * imu.gyro_y_radps + up[2] * imu.gyro_z_radps
            self.angle_rad += rate * min(dt, 1.0)
        self._imu = imu
        self.stamp_ns = max(self.stamp_ns, imu.stamp_ns)

    def _turn_by_odometry(self, odometry: Odometry) -> None:
        """Turn by the rate of odometry."""
        if self._turned_ns:
            dt_s = (odometry.stamp_ns - self._turned_ns) * 1e-9
            self.angle_rad += odometry.rate_z_radps * min(dt_s, 1.0)
        self._turned_ns = odometry.stamp_ns

    def _roll(self, reading: Encoder | Odometry, sensor: SensorConfig) -> None:
        """Advance by the first wheel sensor that speaks; others are not used."""
        last = self._wheel_reading or reading
        if last.sensor == reading.sensor:
            self._wheel_reading = reading
            self._advance(reading.stamp_ns, self._rolled_between(last, reading, sensor))

    def _rolled_between(self, last: Encoder | Odometry, now: Encoder | Odometry, sensor: SensorConfig) -> float:
        dt_s = (now.stamp_ns - last.stamp_ns) * 1e-9
        if isinstance(now, Odometry):
            return now.speed_x_mps * min(dt_s, 1.0)
        assert isinstance(last, Encoder)
        ticks = (now.left_ticks - last.left_ticks + now.right_ticks - last.right_ticks) / 2
        rolled_m = ticks * 2 * math.pi * self._machine.wheel_radius_m / sensor.ticks_per_rev
        return rolled_m if abs(rolled_m) <= MAX_WHEEL_MPS * dt_s else 0.0

    def _advance(self, stamp_ns: int, rolled_m: float) -> None:
        self._rolled_m += rolled_m
        self.wheels.update(stamp_ns, self._rolled_m)
        travel_m = rolled_m * (1 - self._slip * self.traction * math.copysign(1.0, rolled_m))
        self.travel_m += travel_m
        self.distance_m += abs(travel_m)
        steered_rad = travel_m * self._curvature if stamp_ns - self._turned_ns < STALE_S * 1e9 else 0.0
        middle_rad = self.angle_rad + steered_rad / 2
        self._x_m += travel_m * math.cos(middle_rad)
        self._y_m += travel_m * math.sin(middle_rad)
        self.angle_rad += steered_rad
        self.stamp_ns = max(self.stamp_ns, stamp_ns)
