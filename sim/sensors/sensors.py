"""All sensors of all machines: states in, readings out as columns, as objects on demand.

Besides GPS: IMUs, attitude references, wheels, torque, brakes, joint, payload.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.machine.machine_config import BASE, FRONT
from protocol.machine.readings import BrakeForce, Reading
from protocol.rotations import quaternion_from_rpy
from protocol.site.site_config import Projection
from sim.sensors.frames import compose, cross, rotation, seen_turned, turned
from sim.sensors.gps import GpsGroup, VelocityGroup
from sim.sensors.noise import Draws, GaussMarkov, generator
from sim.sensors.rigs import Rig
from sim.sensors.sensor_group import GroupReadings, SensorGroup, SensorUnit
from sim.sensors.vibration import Vibration, shakes
from sim.state import FleetState

_LEVEL = np.zeros(1)


class EncoderGroup(SensorGroup):
    """Rear wheel encoders; counts include slip and true wheel radius."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        self._ticks_per_rad = self.per_unit(lambda unit: unit.sensor.ticks_per_rev) / (2 * np.pi)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:  # noqa: ARG002 - has no noise of its own
        """Ticks, left and right."""
        ticks: Floats = np.floor(self.pick(states.wheel_rad, rows) * self._ticks_per_rad)
        return ticks


class TorqueGroup(SensorGroup):
    """Drive torque at the wheels, as reported."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.torque for unit in units]
        self._white_nm, scale = np.array([(noise.white_nm, noise.scale) for noise in noises]).T
        start = self.per_unit(lambda unit: unit.rng.standard_normal(2))
        self._scale = 1 + scale * start[0]
        self._fault = self.per_unit(lambda unit: unit.rig.faults.torque_scale)
        self._sees_brakes = np.array([noise.sees_brakes for noise in noises])
        slow_nm, time_s = np.array([(noise.correlated_nm, noise.correlation_s) for noise in noises]).T
        self._slow = GaussMarkov(slow_nm[None], time_s, 1 / noises[0].rate_hz, start[1:])
        self._draws = Draws([unit.rng for unit in units], 2)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Torque of all wheels."""
        draws = self._draws.next_rows(len(steps))
        scale = self._scale * np.where(self.faulty(steps), self._fault, 1.0)
        torque = self.pick(states.torque_nm, rows)
        brakes = torque * self.pick(states.speed_mps, rows) < 0
        torque = np.where(brakes & ~self._sees_brakes, 0.0, torque)
        values: Floats = scale * torque + self._slow.run(draws[:1]) + self._white_nm * draws[1]
        return values


class BrakeGroup(SensorGroup):
    """Brakes of machines whose drive does not brake: switch, share of the maximum, or force."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        self._radius_m = self.per_unit(lambda unit: unit.rig.machine.wheel_radius_m)
        self._most_n = self.per_unit(lambda unit: unit.rig.model.max_brake_n)
        self._is_switch = np.array([unit.rig.preset.brake.reads == "switch" for unit in units])
        self._white_n = np.array([unit.rig.preset.brake.white_n for unit in units])
        self._reads_force = units[0].sensor.kind == BrakeForce.kind
        self._draws = Draws([unit.rng for unit in units], 1)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Force, or share of the maximum; a switch closes at 2 %."""
        torque = self.pick(states.torque_nm, rows)
        force = np.abs(torque) * (torque * self.pick(states.speed_mps, rows) < 0) / self._radius_m
        noise = self._white_n * self._draws.next_rows(len(steps)) * (force > 0)  # also adds the axis of values
        if self._reads_force:
            return np.maximum(force + noise, 0.0)
        share = np.minimum(force[None] / self._most_n, 1.0)
        return np.where(self._is_switch, share > 0.02, share)


class ArticulationGroup(SensorGroup):
    """Joint angle."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.articulation for unit in units]
        self._white_rad, zero_rad = np.radians([(noise.white_deg, noise.zero_deg) for noise in noises]).T
        self._zero_rad = zero_rad * self.per_unit(lambda unit: unit.rng.standard_normal())
        self._draws = Draws([unit.rng for unit in units], 1)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Angle of the front frame."""
        noise = self._zero_rad + self._white_rad * self._draws.next_rows(len(steps))
        values: Floats = self.pick(states.articulation_rad, rows) + noise
        return values


class PayloadGroup(SensorGroup):
    """Payload as weighed, never negative."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        self._white_kg, scale = np.array([(u.rig.preset.payload.white_kg, u.rig.preset.payload.scale) for u in units]).T
        self._scale = 1 + scale * self.per_unit(lambda unit: unit.rng.standard_normal())
        self._draws = Draws([unit.rng for unit in units], 1)

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Mass."""
        noise = self._white_kg * self._draws.next_rows(len(steps))
        weighed: Floats = np.maximum(self._scale * self.pick(states.payload_kg, rows) + noise, 0.0)
        return weighed


@dataclass(frozen=True)
class FrameMotion:
    """Motion of a rigid frame, arrays (3, r, u) in its axes: rate, its derivative, specific force at the origin."""

    rates_radps: Floats
    rates_dot_radps2: Floats
    force_mps2: Floats

    def force_at(self, lever_m: Floats) -> Floats:
        """Specific force at a place r on the frame (3, 1, u): f + dw/dt x r + w x (w x r)."""
        turning = cross(self.rates_dot_radps2, lever_m) + cross(self.rates_radps, cross(self.rates_radps, lever_m))
        force: Floats = self.force_mps2 + turning
        return force

    def hinged(self, joint_m: Floats, angle_rad: Floats, radps: Floats, radps2: Floats) -> FrameMotion:
        """Motion of a frame hinged about z on this one; hinge angle, rate, acceleration."""
        rates = seen_turned(angle_rad, self.rates_radps)
        rates_dot = seen_turned(angle_rad, self.rates_dot_radps2)
        rates_dot[0] += radps * rates[1]  # the axes turn under the rear frame's rate
        rates_dot[1] -= radps * rates[0]
        rates_dot[2] += radps2
        rates[2] += radps
        return FrameMotion(rates, rates_dot, seen_turned(angle_rad, self.force_at(joint_m)))


class ImuGroup(SensorGroup):
    """Gyroscopes and accelerometers; three axes of rate, three of force."""

    def __init__(self, units: Sequence[SensorUnit], seed: int) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.imu for unit in units]
        self._gyro_white = np.radians([noise.gyro_white_degps for noise in noises])
        self._force_white, self._vibration, self._full_mps = np.array(
            [(noise.force_white_mps2, noise.force_vibration_mps2, noise.vibration_speed_mps) for noise in noises]
        ).T
        turn_on = [(np.radians(noise.gyro_turn_on_degps), noise.force_turn_on_mps2) for noise in noises]
        drift = [(np.radians(noise.gyro_drift_degps), noise.force_drift_mps2) for noise in noises]
        scale, mounting = np.array([(noise.scale, np.radians(noise.mounting_deg)) for noise in noises]).T

        start = self.per_unit(lambda unit: unit.rng.standard_normal(21))  # turn-on 6, scale 6, mounting 3, drift 6
        self._zero = (np.repeat(np.array(turn_on).T, 3, axis=0) * start[:6])[:, None]
        self._scale = (1 + scale * start[6:12])[:, None]
        tilts = (mounting * start[12:15]).T
        mounts = [unit.sensor.mount.frame_from_sensor() for unit in units]
        sensor_from_frame = [(m @ rotation(tilt)).T for m, tilt in zip(mounts, tilts, strict=True)]
        self._sensor_from_frame = np.ascontiguousarray(np.moveaxis(np.array(sensor_from_frame), 0, -1))
        sigma, time_s = np.repeat(np.array(drift).T, 3, axis=0), np.array([noise.drift_time_s for noise in noises])
        self._drift = GaussMarkov(sigma, time_s, 1 / noises[0].rate_hz, start[15:])
        self._draws = Draws([unit.rng for unit in units], 12)

        self._lever_m = self.per_unit(lambda unit: unit.sensor.mount.xyz_m)[:, None]
        self._joint_m = self.per_unit(lambda unit: unit.rig.model.robot.place(FRONT, BASE).xyz_m)[:, None]
        self._on_front = units[0].sensor.frame == FRONT
        machines = [unit.machine for unit in units]
        self._body = Vibration(noises, machines, seed) if any(map(shakes, noises)) else None

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Angular rate and specific force in the sensor's frame."""
        motion = self._motion(rows, states)
        if self._body:
            speed, turned_rad = self.pick(states.speed_mps, rows), self.pick(states.wheel_rad, rows)[0]
            shaken = self._body.run(steps, speed, turned_rad)
            rates, force = motion.rates_radps + shaken[:3], motion.force_mps2 + shaken[3:]
            motion = FrameMotion(rates, motion.rates_dot_radps2, force)
        truth = (motion.rates_radps, motion.force_at(self._lever_m))
        values: Floats = np.concatenate([turned(self._sensor_from_frame, vector) for vector in truth])
        values *= self._scale
        values += self._zero
        draws = self._draws.next_rows(len(steps))
        values += self._drift.run(draws[:6])
        shaking = self._vibration * np.minimum(np.abs(self.pick(states.speed_mps, rows)) / self._full_mps, 1.0)
        values[:3] += self._gyro_white * draws[6:9]
        values[3:] += np.hypot(self._force_white, shaking) * draws[9:]
        return values

    def _motion(self, rows: Ints, states: FleetState) -> FrameMotion:
        rates = (states.rates_radps, states.rates_dot_radps2)
        rear = FrameMotion(*(self.pick(quantity, rows) for quantity in (*rates, states.force_mps2)))
        if not self._on_front:
            return rear
        hinge = (states.articulation_rad, states.articulation_radps, states.articulation_radps2)
        return rear.hinged(self._joint_m, *(self.pick(q, rows) for q in hinge))


class AttitudeGroup(SensorGroup):
    """Attitude and heading references: quaternion `map_from_sensor`, stated variances.

    Errors of roll and pitch turn about the sensor's x and y, heading errors about the vertical.
    """

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.attitude for unit in units]
        drift = np.radians([(n.tilt_drift_deg, n.tilt_drift_deg, n.heading_drift_deg) for n in noises]).T
        self._white = np.radians([(n.tilt_white_deg, n.tilt_white_deg, n.heading_white_deg) for n in noises]).T
        offset = np.radians([(0.0, 0.0, n.heading_offset_deg) for n in noises]).T
        self._variances = np.maximum(drift**2 + self._white**2 + offset**2, 1e-10)[:, None]
        start = self.per_unit(lambda unit: unit.rng.standard_normal(6))  # offset (only the heading's is used), drift
        self._offset = (offset * start[:3])[:, None]
        time_s = np.array([noise.drift_time_s for noise in noises])
        self._drift = GaussMarkov(drift, time_s, 1 / noises[0].rate_hz, start[3:])
        self._draws = Draws([unit.rng for unit in units], 6)
        roll, pitch, yaw = np.radians(self.per_unit(lambda unit: unit.sensor.mount.rpy_deg))
        self._frame_from_sensor = quaternion_from_rpy(roll, pitch, yaw)[:, None]
        self._on_front = units[0].sensor.frame == FRONT

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Quaternion x, y, z, w; variances of roll, pitch, yaw."""
        draws = self._draws.next_rows(len(steps))
        roll, pitch, heading = self._drift.run(draws[:3]) + self._white[:, None] * draws[3:] + self._offset
        yaw = self.pick(states.yaw_rad, rows) + heading
        orientation = quaternion_from_rpy(self.pick(states.roll_rad, rows), self.pick(states.pitch_rad, rows), yaw)
        if self._on_front:
            angle = self.pick(states.articulation_rad, rows)
            orientation = compose(orientation, quaternion_from_rpy(_LEVEL, _LEVEL, angle))
        orientation = compose(compose(orientation, self._frame_from_sensor), quaternion_from_rpy(roll, pitch, _LEVEL))
        return np.concatenate([orientation, np.broadcast_to(self._variances, draws[:3].shape)])


_GROUPS: dict[str, type[SensorGroup]] = {
    "attitude": AttitudeGroup,
    "torque": TorqueGroup,
    "brake": BrakeGroup,
    "brake_force": BrakeGroup,
    "encoder": EncoderGroup,
    "articulation": ArticulationGroup,
    "payload": PayloadGroup,
}


def _group(kind: str, units: Sequence[SensorUnit], seed: int, projection: Projection) -> SensorGroup:
    """Sensors of one kind; the seed is for errors they share."""
    if kind in ("gps", "gps_velocity"):
        return GpsGroup(units, seed, projection) if kind == "gps" else VelocityGroup(units, seed)
    return ImuGroup(units, seed) if kind == "imu" else _GROUPS[kind](units)


@dataclass(frozen=True)
class FleetReadings:
    """Readings of all sensors. places: (group, column) per sensor of each machine."""

    groups: tuple[GroupReadings, ...]
    places: Sequence[Sequence[tuple[int, int]]]

    def readings(self, machine: int) -> list[Reading]:
        """Readings of one machine by stamp, then in the order of its sensors."""
        own = [reading for group, unit in self.places[machine] for reading in self.groups[group].readings(unit)]
        own.sort(key=lambda reading: reading.stamp_ns)
        return own


class Sensors:
    """The sensors of a fleet.

    A sensor's readings depend on seed, machine index and sensor name alone, neither on other machines and sensors nor
    on batch size.
    """

    def __init__(self, rigs: Sequence[Rig], seed: int, projection: Projection) -> None:
        groups: dict[tuple[str, int, str], list[SensorUnit]] = {}
        places: list[list[tuple[tuple[str, int, str], int]]] = []
        for i, rig in enumerate(rigs):
            places.append([])
            for sensor in rig.off_bus:
                key = (sensor.kind, rig.preset.rate_hz(sensor.kind), sensor.frame)
                group = groups.setdefault(key, [])
                places[i].append((key, len(group)))
                group.append(SensorUnit(i, rig, sensor, generator(seed, i, sensor.name)))
        number = {key: i for i, key in enumerate(groups)}
        self._places = [[(number[key], unit) for key, unit in sensors] for sensors in places]
        self._groups = [_group(kind, units, seed, projection) for (kind, _, _), units in groups.items()]

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> FleetReadings:
        """Read states (arrays (k, n, ...)) after these steps, in time order."""
        return FleetReadings(tuple(group.sample(steps, stamps_ns, states) for group in self._groups), self._places)
