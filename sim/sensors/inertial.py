"""IMUs, and the attitude and heading references in them, on either frame of articulated machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats, Ints
from protocol.machine.machine_config import BASE, FRONT
from protocol.rotations import quaternion_from_rpy
from sim.sensors.frames import compose, cross, rotation, seen_turned, turned
from sim.sensors.noise import Draws, GaussMarkov
from sim.sensors.sensor_group import SensorGroup, SensorUnit
from sim.state import FleetState

_LEVEL = np.zeros(1)


@dataclass(frozen=True)
class FrameMotion:
    """How a rigid frame moves, arrays (3, r, u) in its axes: rate, its derivative, specific force at its origin."""

    rates_radps: Floats
    rates_dot_radps2: Floats
    force_mps2: Floats

    def force_at(self, lever_m: Floats) -> Floats:
        """Specific force at a place r on the frame (3, 1, u): f + dw/dt x r + w x (w x r)."""
        turning = cross(self.rates_dot_radps2, lever_m) + cross(self.rates_radps, cross(self.rates_radps, lever_m))
        force: Floats = self.force_mps2 + turning
        return force

    def hinged(self, joint_m: Floats, angle_rad: Floats, radps: Floats, radps2: Floats) -> FrameMotion:
        """Motion of a frame hinged about z at a place on this one; angle of the hinge, its rate and acceleration."""
        rates = seen_turned(angle_rad, self.rates_radps)
        rates_dot = seen_turned(angle_rad, self.rates_dot_radps2)
        rates_dot[0] += radps * rates[1]  # the axes turn under the rear frame's rate
        rates_dot[1] -= radps * rates[0]
        rates_dot[2] += radps2
        rates[2] += radps
        return FrameMotion(rates, rates_dot, seen_turned(angle_rad, self.force_at(joint_m)))


class ImuGroup(SensorGroup):
    """Gyroscopes and accelerometers; three axes of rate, then three of force."""

    def __init__(self, units: Sequence[SensorUnit]) -> None:
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

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Angular rate and specific force in the sensor's frame."""
        motion = self._motion(rows, states)
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
        """Motion of the frames that carry the sensors."""
        rates = (states.rates_radps, states.rates_dot_radps2)
        rear = FrameMotion(*(self.pick(quantity, rows) for quantity in (*rates, states.force_mps2)))
        if not self._on_front:
            return rear
        hinge = (states.articulation_rad, states.articulation_radps, states.articulation_radps2)
        return rear.hinged(self._joint_m, *(self.pick(q, rows) for q in hinge))


class AttitudeGroup(SensorGroup):
    """Attitude and heading references: quaternion `map_from_sensor` and the variances that they state.

    Errors of roll and pitch turn about the sensor's own x and y, the error of the heading about the vertical.
    """

    def __init__(self, units: Sequence[SensorUnit]) -> None:
        super().__init__(units)
        noises = [unit.rig.preset.attitude for unit in units]
        drift = np.radians([(n.tilt_drift_deg, n.tilt_drift_deg, n.heading_drift_deg) for n in noises]).T
        self._white = np.radians([(n.tilt_white_deg, n.tilt_white_deg, n.heading_white_deg) for n in noises]).T
        offset = np.radians([(0.0, 0.0, n.heading_offset_deg) for n in noises]).T
        self._variances = np.maximum(drift**2 + self._white**2 + offset**2, 1e-10)[:, None]
        start = self.per_unit(lambda unit: unit.rng.standard_normal(6))  # offset (the heading's alone is used), drift
        self._offset = (offset * start[:3])[:, None]
        time_s = np.array([noise.drift_time_s for noise in noises])
        self._drift = GaussMarkov(drift, time_s, 1 / noises[0].rate_hz, start[3:])
        self._draws = Draws([unit.rng for unit in units], 6)
        roll, pitch, yaw = np.radians(self.per_unit(lambda unit: unit.sensor.mount.rpy_deg))
        self._frame_from_sensor = quaternion_from_rpy(roll, pitch, yaw)[:, None]
        self._on_front = units[0].sensor.frame == FRONT

    def read(self, steps: Ints, rows: Ints, states: FleetState) -> Floats:
        """Quaternion x, y, z, w, and the variances of roll, pitch and yaw."""
        draws = self._draws.next_rows(len(steps))
        roll, pitch, heading = self._drift.run(draws[:3]) + self._white[:, None] * draws[3:] + self._offset
        yaw = self.pick(states.yaw_rad, rows) + heading
        orientation = quaternion_from_rpy(self.pick(states.roll_rad, rows), self.pick(states.pitch_rad, rows), yaw)
        if self._on_front:
            angle = self.pick(states.articulation_rad, rows)
            orientation = compose(orientation, quaternion_from_rpy(_LEVEL, _LEVEL, angle))
        orientation = compose(compose(orientation, self._frame_from_sensor), quaternion_from_rpy(roll, pitch, _LEVEL))
        return np.concatenate([orientation, np.broadcast_to(self._variances, draws[:3].shape)])
