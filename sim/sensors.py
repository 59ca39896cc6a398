"""Sensor models: true states of one machine in, raw readings out. Parameters from EVIDENCE, section Simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.machine import SensorConfig
from protocol.readings import Articulation, Encoder, Gps, Imu, Reading, Torque
from protocol.site import Projection
from sim.frames import map_from_base
from sim.noise import GaussMarkov
from sim.world import STEP_S, FleetState

GPS_EVERY, IMU_EVERY, TORQUE_EVERY, WHEELS_EVERY, ARTICULATION_EVERY = 20, 1, 2, 5, 5  # steps: 5, 100, 50, 20, 20 Hz
GPS_VERTICAL = 5 / 3  # heights are this much worse


class Sensor(Protocol):
    """One sensor of one machine."""

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Read off the states (arrays (k, ...)) after the steps with these numbers; their order is that of time."""
        ...


@dataclass(frozen=True)
class GpsNoise:
    """Horizontal standard deviations per axis, correlation time, and when the receiver is silent.

    Silent while (t + phase_s) mod outage_period_s < outage_s.
    """

    drift_std_m: float
    drift_time_s: float
    white_std_m: float
    outage_s: float
    outage_period_s: float
    phase_s: float


class GpsReceiver:
    """A receiver whose antenna sits at the mount; it states its total variances."""

    def __init__(self, config: SensorConfig, noise: GpsNoise, projection: Projection, rng: np.random.Generator) -> None:
        self._name, self._noise, self._projection, self._rng = config.name, noise, projection, rng
        self._lever_m = np.array(config.mount.xyz_m)
        axes = np.array([1.0, 1.0, GPS_VERTICAL])
        self._white_m = noise.white_std_m * axes
        drift_m = noise.drift_std_m * axes
        self._drift = GaussMarkov(drift_m, noise.drift_time_s, GPS_EVERY * STEP_S, rng)
        self._variances = np.maximum(self._white_m**2 + drift_m**2, 1e-4).tolist()

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Fixes of this span; errors run on while the receiver is silent."""
        due = steps % GPS_EVERY == 0
        if not due.any():
            return []
        draws = self._rng.standard_normal((int(due.sum()), 6))
        antenna = np.stack([states.x_m, states.y_m, states.z_m], axis=-1)
        antenna = antenna + map_from_base(self._lever_m, states.yaw_rad, states.pitch_rad, states.roll_rad)
        fixes = antenna[due] + self._drift.run(draws[:, :3]) + self._white_m * draws[:, 3:]
        heard = ~self._silent(steps[due])
        return [self._fix(stamp, fix) for stamp, fix in zip(stamps_ns[due][heard].tolist(), fixes[heard], strict=True)]

    def _silent(self, steps: Ints) -> Bools:
        noise = self._noise
        silent: Bools = (steps * STEP_S + noise.phase_s) % noise.outage_period_s < noise.outage_s - 1e-9
        return silent

    def _fix(self, stamp_ns: int, fix_m: Floats) -> Gps:
        return Gps(self._name, stamp_ns, *self._projection.to_geodetic(*fix_m.tolist()), *self._variances)


@dataclass(frozen=True)
class ImuNoise:
    """Standard deviations per axis: white noise per reading, error at turn-on, slow drift, scale, mounting.

    vibration: added to the white noise of the force while driving, in full from vibration_speed on.
    """

    gyro_white_radps: float = np.radians(0.1)
    gyro_turn_on_radps: float = np.radians(0.05)
    gyro_drift_radps: float = np.radians(0.02)
    force_white_mps2: float = 0.08
    force_vibration_mps2: float = 0.3
    vibration_speed_mps: float = 1.0
    force_turn_on_mps2: float = 0.03
    force_drift_mps2: float = 0.01
    drift_time_s: float = 300.0
    scale: float = 0.002
    mounting_rad: float = np.radians(0.1)


class InertialUnit:
    """Gyroscope and accelerometer at a mount; three axes of rate, then three of force."""

    def __init__(self, config: SensorConfig, noise: ImuNoise, rng: np.random.Generator) -> None:
        self._name, self._noise, self._rng = config.name, noise, rng
        spread = np.repeat([noise.gyro_turn_on_radps, noise.force_turn_on_mps2], 3)
        self._turn_on = spread * rng.standard_normal(6)
        self._scale = 1 + noise.scale * rng.standard_normal(6)
        tilt = np.eye(3) - _cross_matrix(noise.mounting_rad * rng.standard_normal(3))
        self._base_from_sensor = config.mount.base_from_sensor() @ tilt.T
        self._lever_m = np.array(config.mount.xyz_m)
        drift = np.repeat([noise.gyro_drift_radps, noise.force_drift_mps2], 3)
        self._drift = GaussMarkov(drift, noise.drift_time_s, IMU_EVERY * STEP_S, rng)

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Readings of this span."""
        draws = self._rng.standard_normal((len(steps), 12))
        rates, lever = states.rates_radps, self._lever_m
        turning = rates * (rates @ lever)[:, None] - (rates * rates).sum(axis=-1, keepdims=True) * lever
        force = states.force_mps2 + turning - states.rates_dot_radps2 @ _cross_matrix(lever).T
        truth = np.hstack([rates @ self._base_from_sensor, force @ self._base_from_sensor])
        values = self._scale * truth + self._turn_on + self._drift.run(draws[:, :6])
        values += self._white(states.speed_mps) * draws[:, 6:]
        rows = zip(stamps_ns.tolist(), values.tolist(), strict=True)
        return [Imu(self._name, stamp, *row) for stamp, row in rows]

    def _white(self, speed_mps: Floats) -> Floats:
        noise = self._noise
        shaking = noise.force_vibration_mps2 * np.minimum(np.abs(speed_mps) / noise.vibration_speed_mps, 1.0)
        white = np.empty((len(speed_mps), 6))
        white[:, :3] = noise.gyro_white_radps
        white[:, 3:] = np.hypot(noise.force_white_mps2, shaking)[:, None]
        return white


class WheelEncoder:
    """Counts the rear wheels' turns; slip and the wheel's true radius are in what it counts."""

    def __init__(self, config: SensorConfig) -> None:
        self._name, self._ticks_per_rad = config.name, config.ticks_per_rev / (2 * np.pi)

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Counts of this span."""
        due = steps % WHEELS_EVERY == 0
        ticks = np.floor(states.wheel_rad[due] * self._ticks_per_rad).tolist()
        return [Encoder(self._name, t, *row) for t, row in zip(stamps_ns[due].tolist(), ticks, strict=True)]


@dataclass(frozen=True)
class TorqueNoise:
    """Standard deviations: white per reading, correlated over correlation_s, and of the scale."""

    white_nm: float = 600.0
    correlated_nm: float = 300.0
    correlation_s: float = 1.0
    scale: float = 0.03


class TorqueMeter:
    """Drive torque at the wheels, as the drivetrain reports it."""

    def __init__(self, config: SensorConfig, noise: TorqueNoise, rng: np.random.Generator) -> None:
        self._name, self._white_nm, self._rng = config.name, noise.white_nm, rng
        self._scale = 1 + noise.scale * rng.standard_normal()
        self._slow = GaussMarkov(np.array([noise.correlated_nm]), noise.correlation_s, TORQUE_EVERY * STEP_S, rng)

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Readings of this span."""
        due = steps % TORQUE_EVERY == 0
        draws = self._rng.standard_normal((int(due.sum()), 2))
        values = self._scale * states.torque_nm[due] + self._slow.run(draws[:, :1])[:, 0] + self._white_nm * draws[:, 1]
        return [Torque(self._name, t, v) for t, v in zip(stamps_ns[due].tolist(), values.tolist(), strict=True)]


@dataclass(frozen=True)
class ArticulationNoise:
    """Standard deviations: white per reading, and of the zero."""

    white_rad: float = np.radians(0.2)
    zero_rad: float = np.radians(0.3)


class ArticulationSensor:
    """Angle of the joint."""

    def __init__(self, config: SensorConfig, noise: ArticulationNoise, rng: np.random.Generator) -> None:
        self._name, self._white_rad, self._rng = config.name, noise.white_rad, rng
        self._zero = noise.zero_rad * rng.standard_normal()

    def sample(self, steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
        """Readings of this span."""
        due = steps % ARTICULATION_EVERY == 0
        noise = self._zero + self._white_rad * self._rng.standard_normal(int(due.sum()))
        values = (states.articulation_rad[due] + noise).tolist()
        return [Articulation(self._name, t, v) for t, v in zip(stamps_ns[due].tolist(), values, strict=True)]


def sample_all(sensors: Sequence[Sensor], steps: Ints, stamps_ns: Ints, states: FleetState) -> list[Reading]:
    """Readings of all sensors of one machine, in the order of their stamps."""
    readings = [reading for sensor in sensors for reading in sensor.sample(steps, stamps_ns, states)]
    return sorted(readings, key=lambda r: r.stamp_ns)


def _cross_matrix(v: Floats) -> Floats:
    """[v]x, so that [v]x @ u is the cross product of v and u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
