"""Rolling resistance and slope of the ground from torque, wheels and IMU.

c_rr = (F/m - f_x - (lambda - 1) dv/dt) / (g cos(theta)): the accelerometer's f_x already contains gravity's share, so
the grade cancels (DESIGN, "Ground estimation"). A Kalman filter follows c_rr as a random walk; a jump test opens it up
at the border of a zone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from agents.estimation.attitude import AttitudeConfig, SlopeFilter
from agents.physics import GRAVITY_MPS2
from protocol.arrays import Floats
from protocol.machine import BASE, MachineConfig, SensorConfig
from protocol.readings import Imu, Reading, Torque


@dataclass(frozen=True)
class EstimationConfig:
    """How the ground is estimated.

    smooth_s: all signals are low-passed alike with this time. noise: of one raw c_rr, as a density [1/sqrt(Hz)].
    walk: random walk of c_rr per sqrt(s). jump, jump_std: mean innovation that counts as a jump, and the standard
    deviation that c_rr gets then. force_zero_mps2, force_share: standard deviations of the accelerometer's zero, and of
    torque and mass as a share of the drive force. min_speed_mps: below it nothing is learnt of c_rr. stale_s: torque
    older than this is missing.
    """

    smooth_s: float = 0.15
    noise: float = 0.004
    walk: float = 0.003
    jump: float = 0.016
    jump_std: float = 0.05
    force_zero_mps2: float = 0.03
    force_share: float = 0.05
    min_speed_mps: float = 0.4
    stale_s: float = 0.5
    attitude: AttitudeConfig = field(default_factory=AttitudeConfig)

    def __post_init__(self) -> None:
        for name in set(self.__dataclass_fields__) - {"attitude"}:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")


@dataclass(frozen=True)
class GroundEstimate:
    """What is known of the ground under the machine.

    c_rr, c_rr_var: NaN without torque or while standing. slope_x, slope_y: rise over run ahead and to the left, NaN
    without IMU; slope_var of either. pitch_rate_radps: how fast the slope ahead changes.
    """

    c_rr: float
    c_rr_var: float
    slope_x: float
    slope_y: float
    slope_var: float
    pitch_rate_radps: float


UNKNOWN = GroundEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, 0.0)


class GroundEstimator:
    """Estimator of one machine; `update` takes readings in the order of their stamps."""

    def __init__(self, machine: MachineConfig, config: EstimationConfig) -> None:
        self._machine = machine
        self._config = config
        self._ahead = SlopeFilter(config.attitude)
        self._left = SlopeFilter(config.attitude)
        self._rotation: dict[str, Floats] = {}
        self._sensor: str | None = None
        self._imu_ns = 0
        self._torque_ns = 0
        self._drive_n = 0.0
        self._smooth: tuple[float, float, float] | None = None  # drive force, f_x, wheel acceleration
        self._pitch_rate = 0.0
        self._c_rr, self._variance, self._mean_innovation = 0.03, 0.05**2, 0.0
        self._load_n = machine.mass_kg * GRAVITY_MPS2
        self._has_learnt = False

    def update(self, reading: Reading, sensor: SensorConfig, speed_mps: float, accel_mps2: float) -> None:
        """Take in a reading; speed and acceleration are the wheels'."""
        if isinstance(reading, Torque):
            self._drive_n = reading.torque_nm / self._machine.wheel_radius_m
            self._torque_ns = reading.stamp_ns
        elif isinstance(reading, Imu) and self._is_ours(sensor):
            self._sensor = reading.sensor
            if reading.sensor not in self._rotation:
                self._rotation[reading.sensor] = sensor.mount.base_from_sensor()
            dt_s = (reading.stamp_ns - self._imu_ns) * 1e-9 if self._imu_ns else 0.0
            self._imu_ns = reading.stamp_ns
            if 0 < dt_s < 1:
                self._step(reading, self._rotation[reading.sensor], dt_s, speed_mps, accel_mps2)

    def _is_ours(self, sensor: SensorConfig) -> bool:
        """Whether it is the first IMU on the rear frame that has an accelerometer."""
        return sensor.frame == BASE and sensor.says("force") and self._sensor in (None, sensor.name)

    def now(self, speed_mps: float) -> GroundEstimate:
        """The estimate of this moment."""
        if self._smooth is None:
            return UNKNOWN
        slope_x, slope_y = math.tan(self._ahead.angle_rad), math.tan(self._left.angle_rad)
        zero = self._config.force_zero_mps2 / GRAVITY_MPS2
        slope_var = self._ahead.variance_rad2 + zero**2
        knows = self._has_torque() and self._has_learnt and abs(speed_mps) >= self._config.min_speed_mps
        c_rr, c_rr_var = (self._c_rr, self._c_rr_variance()) if knows else (math.nan, math.nan)
        return GroundEstimate(c_rr, c_rr_var, slope_x, slope_y, slope_var, self._pitch_rate)

    def _step(self, imu: Imu, rotation: Floats, dt_s: float, speed_mps: float, accel_mps2: float) -> None:
        gyro = rotation @ (imu.gyro_x_radps, imu.gyro_y_radps, imu.gyro_z_radps)
        force = rotation @ (imu.force_x_mps2, imu.force_y_mps2, imu.force_z_mps2)
        share = 1 - math.exp(-dt_s / self._config.smooth_s)
        raw = (self._drive_n, float(force[0]), accel_mps2)
        old = self._smooth or raw
        self._smooth = (
            old[0] + share * (raw[0] - old[0]),
            old[1] + share * (raw[1] - old[1]),
            old[2] + share * (raw[2] - old[2]),
        )
        rate_up = -float(gyro[1])  # nose up is a negative turn about the y axis, which points to the left
        self._pitch_rate += share * (rate_up - self._pitch_rate)
        self._ahead.update(dt_s, rate_up, float(force[0]) - accel_mps2)
        self._left.update(dt_s, float(gyro[0]), float(force[1]) - speed_mps * float(gyro[2]))
        if self._has_torque() and abs(speed_mps) >= self._config.min_speed_mps:
            self._learn(dt_s, math.copysign(1.0, speed_mps))

    def _learn(self, dt_s: float, direction: float) -> None:
        """One step of the Kalman filter over c_rr; direction is +1 forwards, -1 in reverse."""
        assert self._smooth is not None
        c, m = self._config, self._machine
        drive_n, force_x, accel = self._smooth
        unbalanced = drive_n / m.mass_kg - force_x - (m.rotating_mass_factor - 1) * accel
        raw = direction * unbalanced / (GRAVITY_MPS2 * math.cos(self._ahead.angle_rad))
        self._variance += c.walk**2 * dt_s
        innovation = raw - self._c_rr
        gain = self._variance / (self._variance + c.noise**2 / dt_s)
        self._mean_innovation += 5 * dt_s * (innovation - self._mean_innovation)
        if abs(self._mean_innovation) > c.jump:
            self._variance, self._mean_innovation = max(self._variance, c.jump_std**2), 0.0
        self._c_rr += gain * innovation
        self._variance *= 1 - gain
        self._has_learnt = True

    def _c_rr_variance(self) -> float:
        """Filter variance plus what does not average out: the accelerometer's zero, torque and mass scale."""
        assert self._smooth is not None
        zero = self._config.force_zero_mps2 / GRAVITY_MPS2
        scale = self._config.force_share * self._smooth[0] / self._load_n
        return self._variance + zero**2 + scale**2

    def _has_torque(self) -> bool:
        return self._torque_ns > 0 and self._imu_ns - self._torque_ns < self._config.stale_s * 1e9
