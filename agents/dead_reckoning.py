"""Dead reckoning: distance, turn and speed by wheels and gyros.

Without wheels, speed over ground replaces them (`ground_speed`). Sensors of a kind count as the mean of those heard
within a second: their order does not matter, and one may die.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from agents.ground_speed import FRESH_NS, GroundSpeed, GroundTracker
from protocol.machine.machine_config import BASE, MachineConfig, SensorConfig
from protocol.machine.readings import (
    Encoder,
    Gps,
    GpsVelocity,
    Imu,
    Odometry,
    Payload,
    Reading,
    Steering,
    Torque,
    WheelReading,
)
from protocol.units import GRAVITY_MPS2

WHEELS = ("encoder", "odometry")
TURNS = {"imu": "rate", "odometry": "rate", "steering": "angle"}  # sensors of the turn, best kind first
STALE_S = 2.0  # age at which steering angle, or its speed, expires
SILENT_NS = 3_000_000_000  # silence of wheels after which speed over ground replaces them
MAX_REACH_S = 8.0  # reach of one speed over ground; differences of fixes come more often
LOADING_S = 3.0  # standstill during which a machine may load or dump
PAUSE_S = 1.0  # silence after which a sensor restarts
PAUSE_NS = round(PAUSE_S * 1e9)
MAX_TRACTION = 1.0  # bound of drive force over load, against a wrong unit
MAX_WHEEL_MPS = 30.0  # bound of wheel speed; beyond it the counter was reset
MIN_NARROWING = 0.2  # bound of an inner wheel's share of travel: near the centre of a bend it shows no distance
NOISE_S = 10.0  # time constant of wheel noise
# Variance of tracked speed over that of one correction, for white travel errors, is 0.23 tau / dt (0.20 to 0.27 for dt
# of 0.07 to 0.7 tau).
SPEED_SHARE = 0.23


def turn_source(machine: MachineConfig) -> SensorConfig | None:
    """The sensor of the turn: an IMU with rates, else odometry, else steering.

    Of several, the one that states the least deviation, then by name.
    """
    able = [s for s in machine.sensors if s.kind in TURNS and s.use and s.provides(TURNS[s.kind])]
    return min(able, key=lambda s: ([*TURNS].index(s.kind), s.std.get(TURNS[s.kind], math.inf), s.name), default=None)


class WheelTracker:
    """Speed and acceleration by quantised wheel travel: a third-order fading-memory filter.

    Least-squares parabola with weights exp(-dt / tau_s) (Morrison 1969): stable at any rate, unbiased at constant
    acceleration. It starts as plain least squares (expanding memory, ibid.), until the fading one weighs new readings
    more: `is_settled`. std_mps: deviation of the speed, by corrections while the wheels turn.
    """

    def __init__(self, tau_s: float = 0.15) -> None:
        self.speed_mps = 0.0
        self.accel_mps2 = 0.0
        self.is_settled = False
        self.std_mps = 0.0
        self._turns, self._shown_m = 0, 0.0  # readings with motion, and the last one's travel
        self._tau_s = tau_s
        self.travel_m = 0.0
        self._stamp_ns = 0
        self._count = 0

    def update(self, stamp_ns: int, travel_m: float, speed_mps: float | None = None) -> None:
        """Add total wheel travel; speed_mps, if measured, is the start value."""
        dt = (stamp_ns - self._stamp_ns) * 1e-9
        if not self._stamp_ns or dt > PAUSE_S:
            self.travel_m, self.speed_mps, self.accel_mps2 = travel_m, speed_mps or 0.0, 0.0
            self._stamp_ns, self._count, self.is_settled = stamp_ns, 1, speed_mps is not None
            return
        if dt <= 0:
            return
        self._stamp_ns, self._count = stamp_ns, self._count + 1
        of_travel, of_speed, of_accel = self._gains(math.exp(-dt / self._tau_s))
        self.travel_m += dt * (self.speed_mps + 0.5 * self.accel_mps2 * dt)
        self.speed_mps += dt * self.accel_mps2
        error = travel_m - self.travel_m
        self.travel_m += of_travel * error
        self.speed_mps += of_speed * error / dt
        self.accel_mps2 += of_accel * error / dt**2
        stood, self._shown_m = travel_m == self._shown_m, travel_m
        if self.is_settled and not stood:  # wheels at rest show no noise
            self._turns += 1
            news = SPEED_SHARE * self._tau_s / dt * (of_speed * error / dt) ** 2
            share = max(1 / self._turns, min(dt / NOISE_S, 1.0))
            self.std_mps = math.sqrt(self.std_mps**2 + share * (news - self.std_mps**2))

    def _gains(self, fade: float) -> tuple[float, float, float]:
        """Gains of travel, speed and acceleration, per time step."""
        if not self.is_settled:
            k = self._count
            if k == 2:  # a line through two readings
                return 1.0, 1.0, 0.0
            product = k * (k + 1) * (k + 2)
            self.is_settled = (1 - fade) ** 3 * product >= 60
            if not self.is_settled:
                return 3 * (3 * k * k - 3 * k + 2) / product, 18 * (2 * k - 1) / product, 60 / product
        return 1 - fade**3, 1.5 * (1 - fade) ** 2 * (1 + fade), (1 - fade) ** 3


@dataclass(frozen=True)
class DeadReckonedPose:
    """Pose in dead reckoning's start frame: travel [m], angle [rad], x, y [m]."""

    stamp_ns: int
    travel_m: float
    angle_rad: float
    x_m: float
    y_m: float


@dataclass(frozen=True)
class WheelSpeed:
    """Mean speed and acceleration of the wheels, on average offset_m left of the middle.

    std_mps: measured deviation of the speed. is_known: readings show a speed.
    """

    speed_mps: float = 0.0
    accel_mps2: float = 0.0
    offset_m: float = 0.0
    std_mps: float = 0.0
    is_known: bool = False


@dataclass
class _Wheel:
    """A wheel sensor: last reading, roll so far, and the machine's angle then."""

    reading: WheelReading
    offset_m: float
    angle_rad: float
    rolled_m: float = 0.0
    tracker: WheelTracker = field(default_factory=WheelTracker)


class DeadReckoning:
    """Accumulates wheel travel and turn. Wheel readings of a stamp come last.

    slip: per traction (drive force over weight), removed if torque is measured. weighs: payload readings count.
    mass_kg: with payload; an estimating caller may set it. travel_m, distance_m: of `base_link`, signed and total.
    wheels: at wheels_ns; an excluded wheel is silent. ground: newest speed over ground.
    """

    def __init__(self, machine: MachineConfig, slip: float, *, weighs: bool = True) -> None:
        self.wheels = WheelSpeed()
        self.stamp_ns = 0
        self.travel_m = 0.0
        self.angle_rad = 0.0
        self.distance_m = 0.0
        self.traction = 0.0
        self.mass_kg = machine.mass_kg
        self.wheels_ns = 0
        self._newest_ns = self._resumed_ns = 0  # stamps of the newest reading, and the first after a common pause
        self.ground: GroundSpeed | None = None
        self._stands_since_ns = 0
        self._machine, self._weighs = machine, weighs
        self._slip = slip
        self._up: dict[str, list[float]] = {}  # vertical of `base_link` in gyro axes
        self._gyro_ns: dict[str, int] = {}
        self._wheels: dict[str, _Wheel] = {}
        source = turn_source(machine)
        self._turn_sensor = source.name if source else ""
        self._steers = source is not None and source.kind == "steering"
        self._has_wheels = any(s.kind in WHEELS and s.use and s.provides("speed") for s in machine.sensors)
        self._ground_tracker, self._ground_rad = GroundTracker(turns=source is not None), 0.0
        self._moved_ns = 0  # over ground
        self._turned_ns = 0  # by odometry or steering
        self._curvature = 0.0  # by steering [1/m]
        self._x_m = 0.0
        self._y_m = 0.0

    def update(self, reading: Reading, sensor: SensorConfig) -> None:
        """Add a reading; only wheels, GPS and turn sensors have an effect."""
        if reading.stamp_ns - self._newest_ns > PAUSE_NS:
            self._resumed_ns = reading.stamp_ns
        self._newest_ns = reading.stamp_ns
        if isinstance(reading, Imu) and sensor.frame == BASE and sensor.provides("rate"):
            self._turn(reading, sensor)
        elif isinstance(reading, WheelReading):
            if isinstance(reading, Odometry) and sensor.name == self._turn_sensor:
                self._turn_by_odometry(reading)
            if sensor.provides("speed"):
                self._roll(reading, sensor)
        elif isinstance(reading, Steering) and sensor.name == self._turn_sensor:
            self._curvature = math.tan(reading.angle_rad) / self._machine.wheelbase_m
            self._turned_ns = reading.stamp_ns
        elif isinstance(reading, Gps | GpsVelocity):
            self._follow_ground(reading, sensor)
        elif isinstance(reading, Torque):
            weight_n = self.mass_kg * GRAVITY_MPS2
            self.pull(reading.torque_nm / self._machine.wheel_radius_m / weight_n)
        elif isinstance(reading, Payload) and self._weighs:
            self.mass_kg = self._machine.mass_kg + reading.payload_kg

    def pull(self, traction: float) -> None:
        """Set traction, by wheel torque or a caller's engine."""
        self.traction = traction if abs(traction) <= MAX_TRACTION else 0.0

    @property
    def pose(self) -> DeadReckonedPose:
        """The newest pose."""
        return DeadReckonedPose(self.stamp_ns, self.travel_m, self.angle_rad, self._x_m, self._y_m)

    def is_silent(self, stamp_ns: int) -> bool:
        """Whether wheels are missing or long silent."""
        return not self._has_wheels or stamp_ns - max(self.wheels_ns, self._resumed_ns) > SILENT_NS

    def motion(self, stamp_ns: int) -> WheelSpeed:
        """Speed by wheels, else over ground."""
        if not self.is_silent(stamp_ns):
            return self.wheels
        return WheelSpeed(self.ground.speed_mps, is_known=True) if self.ground else WheelSpeed()

    def still_s(self, stamp_ns: int) -> float:
        """Time without motion, by wheels, else over ground."""
        if not self.is_silent(stamp_ns):
            return (stamp_ns - self._stands_since_ns) * 1e-9
        if not self.ground or stamp_ns - self.ground.stamp_ns > FRESH_NS:
            return 0.0
        return (self.ground.stamp_ns - self._stands_since_ns) * 1e-9

    def show_motion(self, stamp_ns: int) -> None:
        """Deny standstill, by another sensor's evidence."""
        self._stands_since_ns = stamp_ns

    def face(self, heading_rad: float) -> None:
        """Set the heading, after wheels misled speed over ground."""
        self._ground_tracker.face(heading_rad - self.angle_rad)

    def turn_round(self) -> None:
        """Reinterpret the first motion over ground as reverse."""
        self._ground_tracker.turn_round()
        self.ground = None

    def _turn(self, imu: Imu, sensor: SensorConfig) -> None:
        if imu.sensor not in self._up:
            self._up[imu.sensor] = sensor.mount.frame_from_sensor()[2].tolist()
        up = self._up[imu.sensor]
        dt = (imu.stamp_ns - self._gyro_ns.get(imu.sensor, imu.stamp_ns)) * 1e-9
        self._gyro_ns[imu.sensor] = imu.stamp_ns
        speaking = sum([_speaks(last_ns, imu.stamp_ns) for last_ns in self._gyro_ns.values()])
        rate = up[0] * imu.gyro_x_radps + up[1] * imu.gyro_y_radps + up[2] * imu.gyro_z_radps
        self.angle_rad += rate * min(dt, PAUSE_S) / speaking
        self.stamp_ns = max(self.stamp_ns, imu.stamp_ns)

    def _turn_by_odometry(self, odometry: Odometry) -> None:
        if self._turned_ns:
            dt_s = (odometry.stamp_ns - self._turned_ns) * 1e-9
            self.angle_rad += odometry.rate_z_radps * min(dt_s, PAUSE_S)
        self._turned_ns = odometry.stamp_ns

    def _roll(self, reading: WheelReading, sensor: SensorConfig) -> None:
        stamp_ns, offset_m = reading.stamp_ns, sensor.mount.xyz_m[1]
        wheel = self._wheels.setdefault(reading.sensor, _Wheel(reading, offset_m, self.angle_rad))
        others = [w for w in self._wheels.values() if w is not wheel and _speaks(w.reading.stamp_ns, stamp_ns)]
        is_new = not _speaks(wheel.reading.stamp_ns, stamp_ns) or wheel.reading is reading
        is_counted = bool(others) or (self.is_silent(stamp_ns) and self.ground is not None)  # by what moved meanwhile
        rolled_m = 0.0 if is_new and is_counted else rolled_between(wheel.reading, reading, sensor, self._machine)
        if rolled_m or is_new:
            self._stands_since_ns = stamp_ns
        wheel.reading, wheel.rolled_m = reading, wheel.rolled_m + rolled_m
        wheel.tracker.update(stamp_ns, wheel.rolled_m, reading.speed_x_mps if isinstance(reading, Odometry) else None)
        self.wheels, self.wheels_ns = _mean_speed([wheel, *others]), stamp_ns
        self._advance(wheel, rolled_m, 1 + len(others))

    def _advance(self, wheel: _Wheel, rolled_m: float, wheels: int) -> None:
        """Move `base_link` by one of several wheels; in a left bend a left one rolls less."""
        stamp_ns = wheel.reading.stamp_ns
        gripped_m = rolled_m * (1 - self._slip * self.traction * math.copysign(1.0, rolled_m))
        curvature = self._curvature if stamp_ns - self._turned_ns < STALE_S * 1e9 else 0.0
        if self._steers:
            travel_m = gripped_m / narrowing(curvature, wheel.offset_m) / wheels
            self.angle_rad += travel_m * curvature
        else:
            travel_m = (gripped_m + wheel.offset_m * (self.angle_rad - wheel.angle_rad)) / wheels
        self._move(stamp_ns, travel_m, wheel.angle_rad)
        wheel.angle_rad = self.angle_rad

    def _follow_ground(self, reading: Gps | GpsVelocity, sensor: SensorConfig) -> None:
        """Keep the speed over ground, and move by it while wheels are silent."""
        stamp_ns, before, is_silent = reading.stamp_ns, self.ground, self.is_silent(reading.stamp_ns)
        wheels_mps = None if is_silent else self.wheels.speed_mps
        shown = self._ground_tracker.update(reading, sensor, self.angle_rad, wheels_mps)
        if not shown:
            return
        self.ground = shown
        if not shown.stands and stamp_ns - self.wheels_ns > PAUSE_NS:
            self._stands_since_ns = stamp_ns
        if is_silent:
            since_ns = max(self._moved_ns, self.wheels_ns) if before else stamp_ns
            travel_m = shown.speed_mps * min((stamp_ns - since_ns) * 1e-9, MAX_REACH_S)
            curvature = self._curvature if self._steers and stamp_ns - self._turned_ns < STALE_S * 1e9 else 0.0
            self.angle_rad += shown.turned_rad + travel_m * curvature
            self._move(stamp_ns, travel_m, self._ground_rad, counts=shown.moves)
            self._moved_ns = stamp_ns
        self._ground_rad = self.angle_rad

    def _move(self, stamp_ns: int, travel_m: float, from_rad: float, *, counts: bool = True) -> None:
        """Move `base_link` at the mean angle. counts: more than noise."""
        middle_rad = (from_rad + self.angle_rad) / 2
        self.travel_m += travel_m
        self.distance_m += abs(travel_m) * counts
        self._x_m += travel_m * math.cos(middle_rad)
        self._y_m += travel_m * math.sin(middle_rad)
        self.stamp_ns = max(self.stamp_ns, stamp_ns)


def rolled_between(last: WheelReading, now: WheelReading, sensor: SensorConfig, machine: MachineConfig) -> float:
    """Signed roll of a wheel sensor between two readings [m]."""
    dt_s = (now.stamp_ns - last.stamp_ns) * 1e-9
    if isinstance(now, Odometry):
        return now.speed_x_mps * min(dt_s, PAUSE_S)
    assert isinstance(last, Encoder)
    ticks = (now.left_ticks - last.left_ticks + now.right_ticks - last.right_ticks) / 2
    rolled_m = ticks * 2 * math.pi * machine.wheel_radius_m / sensor.ticks_per_rev
    return rolled_m if abs(rolled_m) <= MAX_WHEEL_MPS * dt_s else 0.0


def narrowing(curvature: float, offset_m: float) -> float:
    """Roll of a wheel over travel of its axle's middle: 1 - curvature offset, both positive left, and bounded."""
    return max(1 - curvature * offset_m, MIN_NARROWING)


def _speaks(last_ns: int, now_ns: int) -> bool:
    return now_ns - last_ns <= PAUSE_NS


def _mean_speed(wheels: Sequence[_Wheel]) -> WheelSpeed:
    known = [w for w in wheels if w.tracker.is_settled]
    if not known:
        return WheelSpeed()
    each = [(w.tracker.speed_mps, w.tracker.accel_mps2, w.offset_m, w.tracker.std_mps) for w in known]
    speed_mps, accel_mps2, offset_m, std_mps = (sum(values) / len(known) for values in zip(*each, strict=True))
    return WheelSpeed(speed_mps, accel_mps2, offset_m, std_mps, is_known=True)
