"""Readings to steps of the force balance: drive force over weight, less what the motion takes.

F: drive force; f: specific force ahead at `base_link`; a: wheel acceleration; m, m_0: mass with and without payload;
lambda: rotating mass factor of m_0, as loads do not rotate:

    F / (m g) - (f - g squat) / g - (lambda - 1) (m_0 / m) a / g  =  direction c_rr cos(slope)

F comes from wheels, engine or motor (`powertrain`), less friction behind them, measured brake forces and air drag, rho
c_d A v^2 / 2. The grade cancels: the accelerometer measures gravity's share too.

Squat is the pitch due to payload and longitudinal force. Axle loads of a rigid body, N_f = m (g cos(slope) l_c - f h) /
L and N_r = m g cos(slope) - N_f, compress tyres of stiffness k per axle by N / k. The nose rises by (N_r - N_f) / (k
L), less that of the empty machine on level ground.
"""

import math
from dataclasses import dataclass
from operator import add

from agents.dead_reckoning import DeadReckoning
from agents.estimation.attitude import SlopeFilter
from agents.estimation.powertrain import DriveReadings
from agents.ground_speed import GroundSpeed
from protocol.arrays import Floats
from protocol.machine.machine_config import BASE, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Articulation, Brake, BrakeForce, Imu, Payload, Reading
from protocol.units import GRAVITY_MPS2

STEP_NS = 50_000_000  # balance step: short enough to date a border, long enough to average vibration
MAX_PAUSE_S = 1.0  # age at which readings of IMU, wheels or brakes expire
MAX_GAP_NS = 300_000_000  # gap between balances that interrupts consumers
MAX_GROUND_NS = 2_000_000_000  # age at which speed over ground, about one a second, expires
SLOW_MPS = 2.0  # below it, its own forces pitch a machine, not the ground
MOVES_MPS = 0.2  # below it, friction and brakes act in an unknown direction
AIR_KGPM3 = 1.2  # air density
NO_SUMS = (0.0,) * 8


@dataclass(frozen=True, slots=True)
class Balance:
    """One step of the force balance.

    speed_mps, accel_mps2, distance_m: of the wheels, speed else over ground; distance also counts up in reverse.
    speed_std_mps: by resolution and noise. unbalanced: left side of the equation; share: measured F / (m g); both [-],
    signed ahead. slope_x, slope_y, slope_var: of the body ahead and left without squat [rad, rad2]; sine_x: ahead by
    the accelerometer alone. pitch_radps: nose up. yaw_radps: left. norm_mps2: of the specific force. on_front: load
    share of the front axle, 0 if unknown. body_mps2: acceleration ahead by the accelerometer. torque_s, wheels_s: age
    of the newest reading. mass_kg: with payload. brake: applied share of a brake without force reading, 0 to 1; NaN
    without any brake reading. share_var: of share, by the powertrain. unknown: why the drive force is unknown, or "".
    """

    stamp_ns: int
    dt_s: float
    speed_mps: float
    speed_std_mps: float
    accel_mps2: float
    distance_m: float
    unbalanced: float
    share: float
    slope_x: float
    slope_y: float
    slope_var: float
    sine_x: float
    pitch_radps: float
    yaw_radps: float
    norm_mps2: float
    on_front: float
    body_mps2: float
    torque_s: float
    wheels_s: float
    mass_kg: float
    brake: float
    share_var: float = 0.0
    unknown: str = ""

    @property
    def direction(self) -> float:
        """+1 forwards, -1 in reverse."""
        return math.copysign(1.0, self.speed_mps)


@dataclass(frozen=True, slots=True)
class BalanceStep:
    """One usable step of the force balance: raw = direction cos(slope) c_rr + scale error * share.

    stamp_ns: its end. distance_m: since the last usable step. raw: calibrated [-]. regressor: direction cos(slope) [-].
    share: drive force over weight, signed ahead [-]; share_var: by the powertrain. lead_share: load share of the
    leading axle; wheelbase_m, lead_m: trailing axle and load centre behind it; without a wheelbase, one ground.
    """

    stamp_ns: int
    dt_s: float
    distance_m: float
    raw: float
    regressor: float
    share: float
    lead_share: float = 1.0
    wheelbase_m: float = 0.0
    lead_m: float = 0.0
    share_var: float = 0.0


class Balancer:
    """Collects readings into balances of STEP_NS. weighs: whether payload readings add to the machine's mass."""

    def __init__(self, machine: MachineConfig, *, weighs: bool) -> None:
        self.payload_kg = 0.0
        self._machine = machine
        self._weighs = weighs
        self._slope = SlopeFilter()
        self._bend_rad = 0.0
        self._rotation: dict[str, Floats] = {}
        self._sensor: str | None = None
        self._imu_ns = self._begin_ns = self._wheels_ns = self._ground_ns = 0
        # Count; force ahead at base_link; norm; rates about x, y, z; forces ahead and left that change the speed.
        self._imu_sums = NO_SUMS
        self._rolls = False
        self._drive = DriveReadings(machine)
        self._brakes: dict[str, Brake] = {}
        self._brake_forces: dict[str, BrakeForce] = {}

    @property
    def mass_kg(self) -> float:
        """With payload."""
        return self._machine.mass_kg + self.payload_kg

    @property
    def is_before_wheels(self) -> bool:
        """Whether engine or motor measures the drive."""
        return self._drive.is_before_wheels

    def update(self, reading: Reading, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> Balance | None:
        """Add a reading, after dead reckoning; returns the balance it completes."""
        if self._drive.add(reading):
            return None
        if isinstance(reading, Brake):
            self._brakes[reading.sensor] = reading
        elif isinstance(reading, BrakeForce):
            self._brake_forces[reading.sensor] = reading
        elif isinstance(reading, Articulation):
            self._bend_rad = reading.angle_rad
        elif isinstance(reading, Payload) and self._weighs:
            self.payload_kg = reading.payload_kg
        elif isinstance(reading, Imu) and self._is_in_use(sensor):
            return self._add_imu(reading, sensor, dead_reckoning)
        return None

    def _is_in_use(self, sensor: SensorConfig) -> bool:
        """Whether it is the first rear-frame IMU with an accelerometer."""
        return sensor.frame == BASE and sensor.provides("force") and self._sensor in (None, sensor.name)

    def _add_imu(self, imu: Imu, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> Balance | None:
        if imu.sensor not in self._rotation:
            self._sensor, self._rotation[imu.sensor] = imu.sensor, sensor.mount.frame_from_sensor()
            self._imu_ns = self._begin_ns = imu.stamp_ns
            return None
        dt_s, self._imu_ns = (imu.stamp_ns - self._imu_ns) * 1e-9, imu.stamp_ns
        if not 0 < dt_s < MAX_PAUSE_S:  # restart here
            self._begin_ns, self._imu_sums = imu.stamp_ns, NO_SUMS
            self._drive.restart()
            self._slope.restart()
            return None
        rotation, wheels, (x_m, y_m, z_m) = self._rotation[imu.sensor], dead_reckoning.wheels, sensor.mount.xyz_m
        wx, wy, wz = rotation.dot((imu.gyro_x_radps, imu.gyro_y_radps, imu.gyro_z_radps)).tolist()
        ahead, left, up = rotation.dot((imu.force_x_mps2, imu.force_y_mps2, imu.force_z_mps2)).tolist()
        self._wheels_ns = dead_reckoning.wheels_ns
        rolls = wheels.is_known and self._wheels_s() < MAX_PAUSE_S
        ground = self._fresh(dead_reckoning.ground) if not rolls and dead_reckoning.is_silent(imu.stamp_ns) else None
        accel, speed = (wheels.accel_mps2, wheels.speed_mps) if rolls else (0.0, ground.speed_mps if ground else 0.0)
        at_base = ahead + (wy**2 + wz**2) * x_m  # without the centripetal part at the sensor's mount
        vx, vy, vz = speed + wz * (wheels.offset_m - y_m) + wy * z_m, wz * x_m - wx * z_m, wx * y_m - wy * x_m
        self._rolls = rolls and self._wheels_ns > self._begin_ns
        norm, turned = math.hypot(ahead, left, up), (ahead - wy * vz + wz * vy, left - wz * vx + wx * vz)
        self._imu_sums = tuple(map(add, self._imu_sums, (1, at_base, norm, wx, wy, wz, *turned)))
        if imu.stamp_ns - self._begin_ns < STEP_NS:
            return None
        return self._balance(dead_reckoning, sensor.mount, speed, accel, ground)

    def _balance(
        self, dead_reckoning: DeadReckoning, mount: Mount, speed: float, accel: float, ground: GroundSpeed | None
    ) -> Balance:
        machine, g = self._machine, GRAVITY_MPS2
        n, *sums = self._imu_sums
        force, norm, about_x, about_y, about_z, *turned = (value / n for value in sums)
        rate = -about_y  # the nose rises
        dt_s, self._begin_ns = (self._imu_ns - self._begin_ns) * 1e-9, self._imu_ns
        self._imu_sums, drive = NO_SUMS, self._drive.take(speed)
        # At the sensor, with mean rates because single ones shake; no sideways speed, with wheels or without.
        x_m, y_m, z_m = mount.xyz_m
        ahead = speed + about_z * (dead_reckoning.wheels.offset_m - y_m) + about_y * z_m
        is_new = ground.stamp_ns > self._ground_ns if ground else self._rolls
        at_sensor = (ahead if is_new else None, about_z * x_m - about_x * z_m) if is_new or ground else None
        variance = self._ground_variance(ground, turned[0]) if ground else None
        self._slope.update(dt_s, (about_x, about_y, about_z), turned, at_sensor, variance)
        self._ground_ns = ground.stamp_ns if ground else 0
        share = drive.force_n / (self.mass_kg * g)
        on_front = front_share(machine, self.payload_kg, force)
        squat = squat_rad(machine, self.payload_kg, force)
        bend = self._climb_of_bend(on_front, squat)
        rotating = (machine.rotating_mass_factor - 1) * machine.mass_kg / self.mass_kg
        curve = self._climb_of_curve(on_front, rate, speed)
        unseen = self._unseen_n(speed) / (self.mass_kg * g)
        unbalanced = share - unseen - force / g + squat - bend - curve - rotating * accel / g
        return Balance(
            stamp_ns=self._imu_ns,
            dt_s=dt_s,
            speed_mps=speed,
            speed_std_mps=dead_reckoning.wheels.std_mps,
            accel_mps2=accel,
            distance_m=dead_reckoning.distance_m,
            unbalanced=unbalanced,
            share=share,
            slope_x=math.asin(self._slope.shown_ahead) - squat,
            slope_y=math.asin(self._slope.left),
            slope_var=self._slope.variance,
            sine_x=(self._slope.shown_ahead if ground else (force - accel) / g) - squat,
            pitch_radps=rate,
            yaw_radps=about_z,
            norm_mps2=norm,
            on_front=on_front,
            body_mps2=force - g * self._slope.shown_ahead,
            torque_s=(self._imu_ns - self._drive.stamp_ns) * 1e-9 if self._drive.stamp_ns else math.inf,
            wheels_s=self._wheels_s() if dead_reckoning.wheels.is_known else math.inf,
            mass_kg=self.mass_kg,
            brake=self._brake(),
            share_var=drive.variance_n2 / (self.mass_kg * g) ** 2,
            unknown=drive.unknown,
        )

    def _unseen_n(self, speed_mps: float) -> float:
        """Known force against the motion beyond the torque sensor's, signed ahead."""
        if abs(speed_mps) < MOVES_MPS:
            return 0.0
        drag_n = AIR_KGPM3 * self._machine.drag_area_m2 * speed_mps**2 / 2
        brakes_n = sum(brake.force_n for brake in self._brake_forces.values() if self._is_fresh(brake))
        return math.copysign(drag_n + self._machine.drive_friction_n + brakes_n, speed_mps)

    def _brake(self) -> float:
        applied = [brake.applied for brake in self._brakes.values() if self._is_fresh(brake)]
        reads_force = any(map(self._is_fresh, self._brake_forces.values()))
        return max(applied, default=0.0 if reads_force else math.nan)

    def _is_fresh(self, reading: Reading) -> bool:
        return self._imu_ns - reading.stamp_ns < MAX_PAUSE_S * 1e9

    def _fresh(self, ground: GroundSpeed | None) -> GroundSpeed | None:
        return ground if ground and self._imu_ns - ground.stamp_ns < MAX_GROUND_NS else None

    def _ground_variance(self, ground: GroundSpeed, force_mps2: float) -> float:
        """Variance of a speed over ground [m2/s2], including acceleration since it was measured."""
        accel_mps2 = force_mps2 - GRAVITY_MPS2 * self._slope.shown_ahead
        return ground.std_mps**2 + (accel_mps2 * (self._imu_ns - ground.middle_ns) * 1e-9) ** 2

    def _climb_of_bend(self, on_front: float, squat: float) -> float:
        """Sine of the slope of a bent machine's front frame less the rear's, by the front's load [-].

        Gravity acts along each axle's direction; the accelerometer measures the rear one's.
        """
        c, s = math.cos(self._bend_rad), math.sin(self._bend_rad)
        return on_front * ((self._slope.ahead - squat) * (c - 1) + self._slope.left * s)

    def _climb_of_curve(self, on_front: float, pitch_radps: float, speed_mps: float) -> float:
        """Load-weighted sine of the slope under both axles less that of their line, which is measured [-].

        The slope changes by pitch rate over speed per metre: the front axle's is half a wheelbase's change steeper, the
        rear's less.
        """
        faster_mps = math.copysign(max(abs(speed_mps), SLOW_MPS), speed_mps)
        return (on_front - 0.5) * self._machine.wheelbase_m * pitch_radps / faster_mps

    def _wheels_s(self) -> float:
        return (self._imu_ns - self._wheels_ns) * 1e-9 if self._wheels_ns else math.inf


def front_share(machine: MachineConfig, payload_kg: float, force_mps2: float) -> float:
    """Load share of the front axle [-]; 0 if machine data are missing. force_mps2: specific, ahead, with gravity."""
    if not machine.wheelbase_m:
        return 0.0
    ahead = machine.mass_kg * machine.load_centre_m + payload_kg * machine.payload_x_m  # first moments of mass
    above = machine.mass_kg * machine.cog_height_m + payload_kg * machine.payload_z_m
    lever = ahead - above * force_mps2 / _down(force_mps2)
    return lever / ((machine.mass_kg + payload_kg) * machine.wheelbase_m)


def squat_rad(machine: MachineConfig, payload_kg: float, force_mps2: float) -> float:
    """Nose-up angle [rad] less the empty machine's on level ground; 0 if machine data are missing."""
    if not (machine.wheelbase_m and machine.axle_stiffness_npm):
        return 0.0
    weight_n = (machine.mass_kg + payload_kg) * _down(force_mps2)
    rear_n = weight_n * (1 - 2 * front_share(machine, payload_kg, force_mps2))  # excess over the front axle's
    empty_n = machine.mass_kg * GRAVITY_MPS2 * (1 - 2 * front_share(machine, 0.0, 0.0))
    return (rear_n - empty_n) / (machine.axle_stiffness_npm * machine.wheelbase_m)


def _down(force_mps2: float) -> float:
    """Gravity across the slope on which a steady machine measures this force [m/s2]."""
    return math.sqrt(max(GRAVITY_MPS2**2 - force_mps2**2, 1.0))
