"""Judges wheel sensors by what they roll against fixes, gyro turns and force ahead.

NEEDED contradicting stretches in a row condemn a sensor, unless the IMU sides with it: it feels neither wandering
receivers nor clock differences. A sensor whose starts and stops oppose the accelerometer's needs no fixes. One that is
right again counts again.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from agents.dead_reckoning import PAUSE_NS, PAUSE_S, DeadReckoning, WheelTracker, rolled_between
from agents.ground_speed import moved_variance, velocity_variances
from agents.localisation.imu_steps import Sensed
from agents.localisation.wheels.stretches import Kind, Place, Run, Stretches
from agents.localisation.wheels.travel_sign import TravelSign
from protocol.machine.machine_config import BASE, MachineConfig, SensorConfig
from protocol.machine.readings import Gps, GpsVelocity, Imu, Odometry, WheelReading
from protocol.site.site_config import Projection

NEEDED = 3  # stretches in a row to condemn or acquit; double without accelerometer
UNFELT_MPS, KEPT = 0.4, 0.7  # recent speed that wheels or force miss, and its remainder after a second
WEIGHED_S = 0.09  # least force integration between sign checks: a tenth of a span
BEFORE_NS = 3 * 10**9  # lead of a cause: wheels stop, the machine drives on
STOP_NS = 3 * 10**9  # wheels that stop, not felt within this time, have died
STILL_RADPS = 0.04  # above any gyro bias: no standstill
TURNED_RAD = 0.15  # turn since wheels stopped: more than gyro bias in a run
BACK_M = 0.5  # rolled back: no unsigned counter does that


class Fault(Enum):
    """A wheel sensor's fault, and the remedy."""

    DIED = "stopped while the machine drove on: look at its plug, its cable and its gap"
    CARRIED = "stands while the machine moves: it is carried, or the sensor is dead"
    HALF = "rolls far less than the machine drives: one of its wheels is not counted, or locked"
    SLIPS = "rolls far more than the machine drives: its wheels spin"
    STUCK = "repeats one speed while the machine drives at another: start it again"
    UNSIGNED = "counts up in reverse too: connect its direction, or use a sensor that has one"
    REVERSED = "rolls the other way than the machine drives: change its sign"


OF_SIGN = (Fault.UNSIGNED, Fault.REVERSED)
OTHER_WAY = "feels starts and stops the other way round than the wheels: look at its mount"


@dataclass(frozen=True)
class Fall:
    """A condemned sensor: its errors of position and speed.

    is_headed: whether the heading found with it may be right.
    """

    off_m: float
    off_mps: float
    is_headed: bool


class _ForcedSign(TravelSign):
    """Sign of a wheel speed, and when speed and force last changed independently."""

    unfelt_ns = 0
    is_new = False
    _off_mps = 0.0  # recent speed change by force less that by wheels

    def _add_span(self, accel_mps2: float, force_mps2: float, dt_s: float) -> None:
        mean_accel, mean_force = self._means or (0.0, force_mps2)
        super()._add_span(accel_mps2, force_mps2, dt_s)
        self._off_mps = KEPT * self._off_mps + dt_s * (force_mps2 - mean_force - accel_mps2 + mean_accel)
        self.is_new = True
        if abs(self._off_mps) > UNFELT_MPS and self._last:
            self.unfelt_ns = self._last[0]


@dataclass
class _Wheel:
    """A wheel sensor. place_m: its track in the dead-reckoned frame.

    sums: IMU integrals then. moved_ns, moved_rad: last roll, and the machine's angle. changed_ns: last new speed.
    distance_m, rolled_m, back_m: rolled in total, signed, in reverse.
    """

    reading: WheelReading
    angle_rad: float
    sums: tuple[float, float, float]
    moved_ns: int
    moved_rad: float
    changed_ns: int
    place_m: complex = 0j
    distance_m: float = 0.0
    rolled_m: float = 0.0
    back_m: float = 0.0
    tracker: WheelTracker = field(default_factory=WheelTracker)
    sign: _ForcedSign = field(default_factory=_ForcedSign)


class WheelJudge:
    """Judges a machine's wheel sensors. faults: of excluded ones. fall: the newest verdict, once."""

    def __init__(self, machine: MachineConfig, projection: Projection) -> None:
        self.faults: dict[str, Fault] = {}
        self._machine, self._projection = machine, projection
        used = [s for s in machine.sensors if s.kind == "imu" and s.use and s.frame == BASE and s.provides("force")]
        self._imu = used[0].name if used else ""
        self._base_from_imu = used[0].mount.frame_from_sensor().tolist() if used else []
        self._other_way = False
        self.fall: Fall | None = None
        self._stretches: dict[tuple[str, str], Stretches] = {}
        self._pinned: dict[str, tuple[float, float]] = {}  # last fix of each receiver
        self._sums, self._imu_ns = (0.0, 0.0, 0.0), 0  # integrals of force ahead and pitch rate, and their time
        self._angle_rad = self._before_rad = 0.0  # turned so far, and before a restart
        self.forget_times()

    def forget_times(self) -> None:
        """Discard stamps after a pause or clock change; verdicts stay."""
        self._wheels: dict[str, _Wheel] = {}
        self._placed: dict[str, tuple[int, complex]] = {}  # by velocities
        self._turned, self._moves_ns = (0, 0.0), -PAUSE_NS
        for stretches in self._stretches.values():
            stretches.forget_times()

    def restart(self) -> None:
        """Continue with a restarted dead reckoning."""
        self._before_rad = self._angle_rad

    @property
    def problems(self) -> dict[str, str]:
        """Faults, a sentence by sensor."""
        imu = {self._imu: OTHER_WAY} if self._other_way else {}
        return {name: fault.value for name, fault in self.faults.items()} | imu

    def heard(self, readings: list[Sensed], reckoned: DeadReckoning, factor_of: Callable[[str], float]) -> list[Sensed]:
        """One stamp's readings that count, before dead reckoning; all are judged. factor_of: of variances."""
        self._angle_rad = angle_rad = self._before_rad + reckoned.angle_rad
        for reading, sensor in readings:
            if isinstance(reading, Imu) and reading.sensor == self._imu:
                self._feel(reading)
            elif isinstance(reading, WheelReading) and sensor.provides("speed"):
                self._roll(reading, sensor, angle_rad)
            elif isinstance(reading, Gps | GpsVelocity):
                self._place(reading, sensor, angle_rad, math.sqrt(max(factor_of(reading.sensor), 1.0)))
        self._stand(readings[0][0].stamp_ns, reckoned)
        return [one for one in readings if one[0].sensor not in self.faults] if self.faults else readings

    def _stand(self, now_ns: int, reckoned: DeadReckoning) -> None:
        """Deny standstill while gyro or fixes see motion."""
        since_ns, angle_rad = self._turned
        if (passed_s := (now_ns - since_ns) * 1e-9) >= PAUSE_S:
            if abs(self._angle_rad - angle_rad) > STILL_RADPS * passed_s:
                self._moves_ns = now_ns
            self._turned = now_ns, self._angle_rad
        if 0 <= now_ns - self._moves_ns <= PAUSE_NS:
            reckoned.show_motion(now_ns)

    def _feel(self, imu: Imu) -> None:
        dt_s, self._imu_ns = (imu.stamp_ns - self._imu_ns) * 1e-9, imu.stamp_ns
        if 0 < dt_s < PAUSE_S:
            (x, y, z), (u, v, w), _ = self._base_from_imu
            ahead_mps2 = x * imu.force_x_mps2 + y * imu.force_y_mps2 + z * imu.force_z_mps2
            nose_down_radps = u * imu.gyro_x_radps + v * imu.gyro_y_radps + w * imu.gyro_z_radps
            force_mps, pitch_rad, seconds = self._sums
            self._sums = force_mps + dt_s * ahead_mps2, pitch_rad - dt_s * nose_down_radps, seconds + dt_s

    def _roll(self, now: WheelReading, sensor: SensorConfig, angle_rad: float) -> None:
        name, stamp_ns = now.sensor, now.stamp_ns
        wheel = self._wheels.get(name)
        if wheel is None or abs(stamp_ns - wheel.reading.stamp_ns) > PAUSE_NS:
            self._wheels[name] = _Wheel(now, angle_rad, self._sums, stamp_ns, angle_rad, stamp_ns)
            self._interrupt(name)
            return
        last, speed_mps = wheel.reading, now.speed_x_mps if isinstance(now, Odometry) else None
        rolled_m = rolled_between(last, now, sensor, self._machine)
        if not (isinstance(last, Odometry) and last.speed_x_mps == speed_mps):
            wheel.changed_ns = stamp_ns
        middle_rad = (wheel.angle_rad + angle_rad) / 2
        travel_m = rolled_m + sensor.mount.xyz_m[1] * (angle_rad - wheel.angle_rad)
        wheel.place_m += cmath.rect(travel_m, middle_rad)
        wheel.distance_m, wheel.rolled_m = wheel.distance_m + abs(rolled_m), wheel.rolled_m + rolled_m
        wheel.back_m -= min(rolled_m, 0.0)
        if rolled_m:
            wheel.moved_ns, wheel.moved_rad = stamp_ns, angle_rad
        wheel.reading, wheel.angle_rad = now, angle_rad
        wheel.tracker.update(stamp_ns, wheel.rolled_m, speed_mps)
        self._weigh_sign(wheel)

    def _weigh_sign(self, wheel: _Wheel) -> None:
        sign, name, now_ns = wheel.sign, wheel.reading.sensor, wheel.reading.stamp_ns
        fault = self.faults.get(name)
        if fault == Fault.UNSIGNED and wheel.back_m > BACK_M:
            self._acquit(name)
        seconds = self._sums[2] - wheel.sums[2]
        if seconds < WEIGHED_S:
            return
        force_mps, pitch_rad = self._sums[0] - wheel.sums[0], self._sums[1] - wheel.sums[1]
        wheel.sums = self._sums
        sign.add_force(force_mps / seconds, pitch_rad / seconds, seconds)
        if wheel.tracker.is_settled:
            sign.add_speed(now_ns, wheel.tracker.speed_mps)
        if not sign.is_new:
            return
        sign.is_new = False
        if fault == Fault.REVERSED and sign.sign > 0:
            self._acquit(name)
        elif fault is None and (shown := sign.sign):
            self._other_way = shown < 0 and wheel.back_m < wheel.distance_m / 2  # machines drive ahead more than back
            if shown < 0 and not self._other_way:
                self._condemn(name, Fault.REVERSED, Fall(0.0, 0.0, is_headed=False))

    def _place(self, reading: Gps | GpsVelocity, sensor: SensorConfig, angle_rad: float, worse: float) -> None:
        """Compare wheel sensors with a receiver, whose deviation is `worse` times the stated."""
        now_ns, lever_m = reading.stamp_ns, complex(*sensor.mount.xyz_m[:2])
        fix_m = self._integrated(reading) if isinstance(reading, GpsVelocity) else self._fixed(reading)
        if fix_m is None:
            return
        for name, wheel in self._wheels.items():
            stretches = self._stretches.setdefault((reading.sensor, name), Stretches())
            if now_ns - wheel.reading.stamp_ns > PAUSE_NS:
                stretches.interrupt()
                continue
            now = Place(now_ns, fix_m, wheel.place_m, wheel.distance_m, wheel.rolled_m, angle_rad, lever_m)
            begin = stretches.begin or now
            if run := stretches.add(now, worse * _std_m(reading, sensor, (now_ns - begin.stamp_ns) * 1e-9)):
                self._note(name, run, now)

    def _fixed(self, fix: Gps) -> complex | None:
        pinned = fix.lat_deg, fix.lon_deg
        if self._pinned.get(fix.sensor) == pinned:
            return None
        self._pinned[fix.sensor] = pinned
        x, y, _ = self._projection.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
        return complex(x, y)

    def _integrated(self, velocity: GpsVelocity) -> complex:
        name, now_ns = velocity.sensor, velocity.stamp_ns
        last_ns, place_m = self._placed.get(name, (now_ns, 0j))
        dt_s = (now_ns - last_ns) * 1e-9
        if dt_s > 2 * PAUSE_S:
            self._interrupt(name)
        place_m += dt_s * complex(velocity.velocity_e_mps, velocity.velocity_n_mps)
        self._placed[name] = now_ns, place_m
        return place_m

    def _interrupt(self, sensor: str) -> None:
        for pair, stretches in self._stretches.items():
            if sensor in pair:
                stretches.interrupt()

    def _note(self, name: str, run: Run, now: Place) -> None:
        wheel, fault, kind = self._wheels[name], self.faults.get(name), run.kind
        if kind == Kind.STANDS:
            self._moves_ns = now.stamp_ns
        may_recover = fault and fault not in OF_SIGN and not (fault == Fault.STUCK and _repeats(wheel, run))
        if may_recover and kind == Kind.AGREES and run.count >= NEEDED:
            self._acquit(name)
        needed = NEEDED if self._imu else 2 * NEEDED
        if kind in (Kind.AGREES, Kind.UNCLEAR) or run.count < needed or fault or not self._is_doubtful(wheel, run, now):
            return
        beside = (stretches for (_, wheels), stretches in self._stretches.items() if wheels == name)
        if not any(other.agreed_ns > run.begin.stamp_ns for other in beside):
            seconds = (now.stamp_ns - run.begin.stamp_ns) * 1e-9
            self._condemn(name, _fault(wheel, run, now), Fall(run.off_m, run.off_m / seconds, is_headed=True))

    def _is_doubtful(self, wheel: _Wheel, run: Run, now: Place) -> bool:
        """Whether the IMU contradicts the wheels too, or is missing."""
        turned_rad = abs(now.angle_rad - wheel.moved_rad) if run.kind == Kind.STANDS else 0.0
        return not self._imu or wheel.sign.unfelt_ns > run.begin.stamp_ns - BEFORE_NS or turned_rad > TURNED_RAD

    def _condemn(self, name: str, fault: Fault, fall: Fall) -> None:
        self.faults[name], self.fall = fault, fall
        self._wheels[name].sign.forget()

    def _acquit(self, name: str) -> None:
        del self.faults[name]
        self._wheels[name].sign.forget()


def _fault(wheel: _Wheel, run: Run, now: Place) -> Fault:
    if run.kind == Kind.STANDS:
        return Fault.DIED if abs(wheel.sign.unfelt_ns - wheel.moved_ns) < STOP_NS else Fault.CARRIED
    if run.kind != Kind.OPPOSITE:
        slips = Fault.SLIPS if run.kind == Kind.SLIPS else Fault.HALF
        return Fault.STUCK if _repeats(wheel, run) else slips
    is_ahead = now.rolled_m > run.begin.rolled_m
    return Fault.UNSIGNED if is_ahead and wheel.back_m < BACK_M else Fault.REVERSED


def _repeats(wheel: _Wheel, run: Run) -> bool:
    return wheel.changed_ns <= run.begin.stamp_ns


def _std_m(reading: Gps | GpsVelocity, sensor: SensorConfig, seconds: float) -> float:
    if isinstance(reading, GpsVelocity):
        return seconds * math.sqrt(sum(velocity_variances(reading, sensor)) / 2)
    return math.sqrt(moved_variance(reading, sensor, seconds))
