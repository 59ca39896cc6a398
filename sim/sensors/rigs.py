"""A machine's sensors: what its agent may know, their errors, and faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.config import require_between
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from sim.machines.chassis import Bodies
from sim.machines.model import MachineModel
from sim.sensors.noise import generator
from sim.sensors.presets import BRAKE_READINGS, GpsNoise, Preset

# Sensors on a machine's bus, by stream of `agents.drivers.can` or maker's signal.
CAN_SENSORS = {
    "engine": SensorConfig("engine", "engine"),
    "losses": SensorConfig("losses", "engine_losses"),
    "gearbox": SensorConfig("gearbox", "driveline"),
    "rear_speed": SensorConfig("speed", "odometry", measures=("speed",)),
    "brake_switch": SensorConfig("brakes", "brake"),
    "retarder": SensorConfig("retarder", "retarder"),
    "fuel": SensorConfig("fuel", "fuel_rate"),
    "pump": SensorConfig("pump", "hydraulic_pressure"),
}


@dataclass(frozen=True)
class Faults:
    """Faults from simulated time from_s on, beyond the preset's errors.

    torque_scale: factor on reported torque. antenna_off_m: true minus configured antenna position, in `base_link`.
    clock_off_s: how far all stamps are ahead. rolling: factor on the tyres' rolling resistance, from the start.
    """

    from_s: float = 0.0
    torque_scale: float = 1.0
    antenna_off_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_off_s: float = 0.0
    rolling: float = 1.0

    def __post_init__(self) -> None:
        require_between(self, 0, 1e7, "from_s")
        require_between(self, 0, 10, "torque_scale")
        require_between(self, 0.1, 10, "rolling")
        require_between(self, -1e6, 1e6, "clock_off_s")
        if not all(abs(off) <= 100 for off in self.antenna_off_m):
            raise ValueError(f"antenna_off_m: {self.antenna_off_m!r} is more than 100 m away")


@dataclass(frozen=True)
class Rig:
    """One machine's sensors. machine: what its agent may know; the rest is for the simulator.

    can: drive train on a bus (`CAN_SENSORS`) in place of wheel sensors.
    """

    machine: MachineConfig
    model: MachineModel
    preset: Preset
    faults: Faults = Faults()
    can: bool = False

    @property
    def feeds(self) -> dict[str, SensorConfig]:
        """Sensor per stream on its bus."""
        return {stream: s for stream, s in CAN_SENSORS.items() if self.can and s in self.machine.sensors}

    @property
    def off_bus(self) -> tuple[SensorConfig, ...]:
        """Sensors on no bus."""
        on_bus = self.feeds.values()
        return tuple(sensor for sensor in self.machine.sensors if sensor not in on_bus)


def machine_config(
    name: str,
    model: MachineModel,
    preset: Preset,
    gps: tuple[int, ...],
    imu: tuple[int, ...],
    attitude: tuple[int, ...],
    *,
    payload: bool = False,
    doppler: bool = False,
    can: bool = False,
) -> MachineConfig:
    """Machine as its agent knows it; sensors by their URDF numbers.

    attitude: IMUs with orientation. payload: weighed. doppler: receivers state velocities. can: a bus replaces wheel
    sensors. Fast sensors come first, so that readings of one stamp have the same order live, in bundles and in logs.
    """
    ticks = preset.encoder.ticks_per_rev
    sensors = [_inertial("imu", number, model) for number in imu]
    sensors += [_inertial("attitude", number, model) for number in attitude]
    if not can:
        sensors += [SensorConfig("torque", "torque"), SensorConfig("wheels", "encoder", ticks_per_rev=ticks)]
    sensors += [] if model.skid_grip else [SensorConfig("articulation", "articulation")]
    sensors += [_receiver(number, model, preset.gps) for number in gps]
    mounts = model.gps_mounts()
    sensors += [SensorConfig(f"doppler-{number}", "gps_velocity", mounts[number - 1]) for number in gps if doppler]
    sensors += [SensorConfig("payload", "payload")] if payload else []
    sensors += [SensorConfig("brake", kind)] if not can and (kind := BRAKE_READINGS[preset.brake.reads]) else []
    sensors.sort(key=lambda sensor: -preset.rate_hz(sensor.kind))
    sensors += can_sensors(model) if can else []
    payload_x_m, _, payload_z_m = np.round(model.payload_centre_m, 2).tolist()  # precision of a data sheet
    return MachineConfig(
        name,
        mass_kg=model.mass_kg,
        wheel_radius_m=model.wheel_radius_m,
        load_centre_m=model.load_centre_m,
        rotating_mass_factor=model.rotating_mass_factor,
        skid_steers=True if model.skid_grip else None,
        wheelbase_m=round(model.wheelbase_m, 3),
        axle_stiffness_npm=2 * model.tyre_stiffness_npm,
        cog_height_m=round(model.centre_height_m(), 2),
        payload_x_m=payload_x_m,
        payload_z_m=payload_z_m,
        sensors=tuple(sensors),
        powertrain=model.drive_train.data_sheet if can and model.drive_train else None,
    )


def can_sensors(model: MachineModel) -> list[SensorConfig]:
    """Sensors on the bus of a kind of machine."""
    if not model.drive_train:
        raise ValueError(f"can: a {model.name} has no drive train that speaks on a bus")
    has_pump = model.drive_train.hydraulics > 0
    return [sensor for stream, sensor in CAN_SENSORS.items() if has_pump or stream != "pump"]


def draw_bodies(rigs: Sequence[Rig], seed: int) -> Bodies:
    """Draw true bodies around the nominal ones."""
    mass_kg, radius_m = np.empty(len(rigs)), np.empty(len(rigs))
    for i, rig in enumerate(rigs):
        rng, spread = generator(seed, i, "body"), rig.preset.body
        mass_kg[i] = rig.machine.mass_kg * (1 + spread.mass * rng.uniform(-1, 1))
        radius_m[i] = rig.machine.wheel_radius_m * (1 + spread.wheel_radius * rng.standard_normal())
    return Bodies(mass_kg, radius_m, np.array([rig.faults.rolling for rig in rigs]))


def _inertial(kind: str, number: int, model: MachineModel) -> SensorConfig:
    mounts = model.imu_mounts()
    _check_number(kind, number, len(mounts), model)
    frame, mount = mounts[number - 1]
    return SensorConfig(f"{kind}-{number}", kind, mount, frame=frame)


def _receiver(number: int, model: MachineModel, noise: GpsNoise) -> SensorConfig:
    mounts: tuple[Mount, ...] = model.gps_mounts()
    _check_number("gps", number, len(mounts), model)
    share, time_s = _slow(noise)
    return SensorConfig(f"gps-{number}", "gps", mounts[number - 1], drift_share=share, drift_time_s=time_s)


def _slow(noise: GpsNoise) -> tuple[float, float]:
    """Slow share of a receiver's variance, and its correlation time."""
    total = math.hypot(noise.drift_std_m, noise.white_std_m)
    share = round((noise.drift_std_m / total) ** 2, 2) if total else 0.0  # precision of a data sheet
    return share, noise.drift_time_s


def _check_number(kind: str, number: int, count: int, model: MachineModel) -> None:
    if not 1 <= number <= count:
        raise ValueError(f"{kind}: a {model.name} has no number {number}; it has 1 to {count}")
