"""Drive force from what wheels, engine or motor state: the powertrain's ratios and losses, and where they end.

An engine states its indicated torque as a share of a reference torque T_ref: friction and auxiliary drives take a part
of it. With gear and final drive i, efficiency eta and wheels of radius r,

    F = (torque - losses) T_ref i eta / r        with 1 / eta where the wheels drive the engine

The gear is the one whose ratio the speeds of engine and wheels have; between two gears something slips. A retarder
behind the gearbox takes its torque, by the final drive. Where a clutch, a converter, hydraulics or a retarder of
unknown torque leave the force unknown, a reason stands in its place.
"""

import math
from dataclasses import dataclass

from protocol.machine.machine_config import MachineConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import (
    Driveline,
    Engine,
    EngineLosses,
    HydraulicPressure,
    Motor,
    MotorPower,
    Reading,
    Retarder,
    Torque,
)

STEP = 0.01  # of the torque of an engine, its losses and a retarder, in shares of their reference torque (J1939)
RETARDER_STD = 0.05  # of a retarder's torque: controllers know it by its pressure; assumed
SAME_GEAR = 0.07  # logarithm of two ratios: gears of a 16-speed gearbox differ by 0.18; tyres wear, speeds have steps
CREEPS_MPS = 0.5  # power over a lower speed is no force
MAX_AGE_NS = 10**9  # of what is read beside the torque; EEC3 comes each 250 ms
# The value that is averaged over a step, by the kind of reading; where several kinds come in, the first counts.
DRIVES = {Torque: "torque_nm", Motor: "torque_nm", MotorPower: "power_w", Engine: "torque"}
BESIDE = EngineLosses, Driveline, HydraulicPressure, Retarder


@dataclass(frozen=True, slots=True)
class Drive:
    """Drive force [N], signed ahead; its variance by how it is stated [N2]; why it is not known, "" where it is."""

    force_n: float = 0.0
    variance_n2: float = 0.0
    unknown: str = ""


class DriveReadings:
    """Collects what drives a machine. stamp_ns: of the newest reading that counts, 0 before the first."""

    def __init__(self, machine: MachineConfig) -> None:
        self.stamp_ns = 0
        self._radius_m, self._train = machine.wheel_radius_m, machine.powertrain or PowertrainConfig()
        self._kind: type[Reading] | None = None
        self._newest: dict[type[Reading], Reading] = {}
        self._sums = 0, 0.0

    def add(self, reading: Reading) -> bool:
        """Take in a reading; returns whether it is of this kind."""
        kind = type(reading)
        if name := DRIVES.get(kind):
            order = list(DRIVES)
            if self._kind in (None, kind) or order.index(kind) < order.index(self._kind):
                self._sums = self._sums if self._kind is kind else (0, 0.0)
                self._kind, self.stamp_ns, self._newest[kind] = kind, reading.stamp_ns, reading
                self._sums = self._sums[0] + 1, self._sums[1] + getattr(reading, name)
            return True
        if kind in BESIDE:
            self._newest[kind] = reading
        return kind in BESIDE

    @property
    def is_before_wheels(self) -> bool:
        """Whether engine or motor state the drive, and no reading of the wheels."""
        return self._kind not in (None, Torque)

    def restart(self) -> None:
        """Begin a step anew."""
        self._sums = 0, 0.0

    def take(self, speed_mps: float) -> Drive:
        """The drive force over the step that ends; of what came in before it, where nothing came in it."""
        drive, retarder = self._driven(speed_mps), self._fresh(Retarder)
        if drive.unknown or not self.is_before_wheels or not isinstance(retarder, Retarder):
            return drive
        return retarded(self._train, drive, retarder.torque, speed_mps, self._radius_m)

    def _driven(self, speed_mps: float) -> Drive:
        (n, total), self._sums = self._sums, (0, 0.0)
        newest = self._newest.get(self._kind) if self._kind else None
        if newest is None:
            return Drive()
        value = total / n if n else getattr(newest, DRIVES[type(newest)])
        match newest:
            case Motor():
                return Drive(motor_force(self._train, value, speed_mps) / self._radius_m)
            case MotorPower():
                return power_drive(self._train, value, speed_mps)
            case Engine():
                return self._engine(newest, value, speed_mps)
        return Drive(value / self._radius_m)

    def _engine(self, engine: Engine, torque: float, speed_mps: float) -> Drive:
        losses, driveline, hydraulics, _ = map(self._fresh, BESIDE)
        why = slips(driveline) if isinstance(driveline, Driveline) else ""
        if idle_pa := self._train.idle_pressure_pa:
            is_idle = isinstance(hydraulics, HydraulicPressure) and hydraulics.pressure_pa <= idle_pa
            why = why or ("" if is_idle else "hydraulics")
        if why:
            return Drive(unknown=why)
        share = torque - (losses.friction if isinstance(losses, EngineLosses) else self._train.losses)
        return engine_drive(self._train, share, engine.speed_radps, speed_mps, self._radius_m)

    def _fresh(self, kind: type[Reading]) -> Reading | None:
        reading = self._newest.get(kind)
        return reading if reading and self.stamp_ns - reading.stamp_ns < MAX_AGE_NS else None


def engine_drive(
    train: PowertrainConfig, share: float, engine_radps: float, speed_mps: float, radius_m: float
) -> Drive:
    """Drive force of an engine. share: its torque without losses, of the reference torque; speed_mps: of the wheels."""
    ratio = gear_ratio(train, engine_radps, speed_mps / radius_m)
    if not ratio:
        return Drive(unknown="no_gear")
    per_share_n = train.reference_torque_nm * ratio / radius_m
    return Drive(_handed_on(train, share, 1.0) * per_share_n, 2 * _step_variance(per_share_n))


def retarded(train: PowertrainConfig, drive: Drive, share: float, speed_mps: float, radius_m: float) -> Drive:
    """What is left of a drive force while a retarder brakes with a share of its torque."""
    per_share_n = train.retarder_torque_nm * train.final_drive / radius_m
    if not share or not per_share_n:
        return Drive(unknown="braking") if share else drive
    force_n = share * per_share_n
    variance = drive.variance_n2 + (RETARDER_STD * force_n) ** 2 + _step_variance(per_share_n)
    return Drive(drive.force_n - math.copysign(force_n, speed_mps), variance)


def motor_force(train: PowertrainConfig, torque_nm: float, speed_mps: float) -> float:
    """Torque at the wheels [N m] by that of a motor, both positive ahead."""
    return _handed_on(train, torque_nm, speed_mps) * train.gears[0] * train.final_drive


def power_drive(train: PowertrainConfig, power_w: float, speed_mps: float) -> Drive:
    """Drive force by a motor's power, negative where it brakes."""
    if abs(speed_mps) < CREEPS_MPS:
        return Drive(unknown="creeps")
    return Drive(_handed_on(train, power_w, 1.0) / speed_mps)


def slips(driveline: Driveline) -> str:
    """Why a driveline hands no known torque on; "" where it does."""
    if driveline.engaged < 1:
        return "clutch"
    if driveline.shifting > 0:
        return "gear_change"
    return "" if driveline.locked >= 1 else "converter"


def gear_ratio(train: PowertrainConfig, engine_radps: float, wheel_radps: float) -> float:
    """Turns of the engine per turn of a wheel in the gear that these speeds show, negative in reverse; 0 where none."""
    if not (engine_radps > 0 and wheel_radps):
        return 0.0
    gears = train.gears if wheel_radps > 0 else train.reverse_gears
    ratios = [gear * train.final_drive for gear in gears]
    measured = engine_radps / abs(wheel_radps)
    off, ratio = min(((abs(math.log(measured / ratio)), ratio) for ratio in ratios), default=(math.inf, 0.0))
    return math.copysign(ratio, wheel_radps) if off < SAME_GEAR else 0.0


def _step_variance(per_share_n: float) -> float:
    """Of a force by a share in steps, each as likely anywhere in its step."""
    return (STEP * per_share_n) ** 2 / 12


def _handed_on(train: PowertrainConfig, value: float, direction: float) -> float:
    """What arrives at the wheels of torque or power; losses help to brake."""
    return value * train.efficiency if value * direction > 0 else value / train.efficiency
