"""Slope along and across the machine: the vertical in body axes, by gyros, accelerometer and wheels.

u: vertical in body axes (ahead, left, up); omega: gyro rates; f: specific force by an accelerometer of bias z; v:
velocity at its mount:

    du/dt = -omega x u          dv/dt = f - g (u + z) - omega x v

Gyros turn u. Integrated forces are compared with the wheels' velocity: their speed ahead, none sideways but for turning
at the sensor and tyre slip. Wheel travel is not differentiated twice: a late acceleration looks like a slope. In turns
bias moves along and slope does not; slip comes and goes with the bend. By the linear tyre model the slip angle is k
times the sideways acceleration a = omega_z v_x:

    v_y = -k a |v_x|            dv_x/dt = ... - k a^2 sign(v_x)

GPS speeds replace missing wheels ahead, each with its variance. u ahead and left is the sine of each slope, positive
uphill.
"""

import math
from collections.abc import Sequence

import numpy as np

from protocol.arrays import Floats
from protocol.units import GRAVITY_MPS2

MAX_SINE = 0.7  # upper bound of the sine; no machine stands steeper
FIRST_STD = 0.05  # initial standard deviation of the sine
FIRST_SPEED_STD_MPS = 5.0  # initial standard deviation before wheels report
RATE_WALK = 3e-4  # random walk of the angle [rad/sqrt(s)]: a cheap gyro, 0.17 deg/s at 100 Hz
BIAS_STD_RADPS = 2e-3  # initial gyro bias: 0.1 deg/s
BIAS_WALK = 3.5e-5  # random walk of the gyro bias [rad/s/sqrt(s)]: 0.1 deg/s per hour
ZERO_STD = 0.01  # initial accelerometer bias over g, uncalibrated
ZERO_WALK = 1e-4  # random walk of that bias [1/sqrt(s)]: about ZERO_STD again in an hour
FORCE_WALK = 0.05  # of integrated forces [m/s/sqrt(s)]: vibration of 0.35 m/s2, white over 20 ms
SPEED_WALK = 0.027  # noise of wheel speed [m/s sqrt(s)]: 0.05 m/s, correlated over 0.3 s
# Wheel speeds that jump by more than this against the forces slip or grip again, and say nothing of slope. One sigma,
# because correlated noise counts as independent. Speed over ground does not slip, but has outliers.
JUMP_SIGMA, OUTLIER_SIGMA = 1.0, 3.0
MAX_JUMPS_S = 3.0  # jumps at every step for this long mean a wrong slope, after a shock or fault
SLIP_STD = 0.03  # initial slip angle per sideways acceleration [rad s2/m]: 0.01 firm, 0.03 on sand
SLIP_WALK = 1e-3  # its random walk [rad s2/m/sqrt(s)]: other ground in a quarter of an hour
MAX_LATERAL_MPS2 = 5.0  # upper bound of sideways acceleration that tyres hold
SINES, BIASES, ZEROS, SPEEDS = (slice(i, i + 2) for i in (0, 2, 4, 6))  # slices of the state, each ahead and left
SLIP = 8


class SlopeFilter:
    """Kalman filter of the sines of the slopes ahead and to the left, for one IMU.

    State (9,): both sines, biases of their rates [rad/s], accelerometer biases over g, speeds [m/s], and tyre slip
    angle per sideways acceleration [rad s2/m]. Turning couples the directions.
    """

    def __init__(self) -> None:
        self._x: Floats = np.zeros(9)
        self._covariance: Floats = np.diag(
            _state([FIRST_STD, BIAS_STD_RADPS, ZERO_STD, FIRST_SPEED_STD_MPS], SLIP_STD) ** 2
        )
        self._is_started = False
        self._jumps_s = 0.0  # duration of uninterrupted jumps

    @property
    def ahead(self) -> float:
        """Sine of the slope ahead."""
        return _bounded(self._x[0])

    @property
    def left(self) -> float:
        """Sine of the slope to the left."""
        return _bounded(self._x[1])

    @property
    def shown_ahead(self) -> float:
        """Sine of the slope ahead including accelerometer bias."""
        return _bounded(self._x[0] + self._x[4])

    @property
    def variance(self) -> float:
        """Of `shown_ahead`."""
        P = self._covariance
        return float(P[0, 0] + 2 * P[0, 4] + P[4, 4])

    def restart(self) -> None:
        """Restart slopes and speeds after a pause or shock; biases remain."""
        self._is_started = False

    def update(
        self,
        dt_s: float,
        rates_radps: Sequence[float],
        force_mps2: Sequence[float],
        speed_mps: Sequence[float | None] | None,
        variance: float | None = None,
    ) -> None:
        """Predict with means over dt_s; correct with the speed at its end (None: unknown).

        rates_radps: about ahead, left, up. force_mps2: ahead and left, with gravity, without omega x v. speed_mps:
        ahead and left, at the sensor. variance: of the speed ahead, None for wheels.
        """
        if not self._is_started:
            self._start(force_mps2)
        else:
            self._predict(dt_s, rates_radps, force_mps2)
        if speed_mps is not None:
            jumped = self._correct(self._lateral_mps2(rates_radps[2]), speed_mps, SPEED_WALK**2 / dt_s, variance)
            self._jumps_s = self._jumps_s + dt_s if jumped else 0.0
            if self._jumps_s > MAX_JUMPS_S:
                self.restart()

    def _start(self, force_mps2: Sequence[float]) -> None:
        P = self._covariance
        for i, first in ((SINES, FIRST_STD), (SPEEDS, FIRST_SPEED_STD_MPS)):
            P[i], P[:, i] = 0.0, 0.0
            P[i, i] = np.diag([first**2] * 2)
        self._x[SINES] = np.clip(np.array(force_mps2) / GRAVITY_MPS2 - self._x[ZEROS], -MAX_SINE, MAX_SINE)
        self._x[SPEEDS], self._jumps_s = 0.0, 0.0
        self._is_started = True

    def _predict(self, dt_s: float, rates_radps: Sequence[float], force_mps2: Sequence[float]) -> None:
        ahead, left, bias_ahead, bias_left, zero_ahead, zero_left, speed, _, slip = self._x.tolist()
        about_x, about_y, about_z = rates_radps
        up = math.sqrt(max(1 - ahead**2 - left**2, MAX_SINE**2))
        c, s, fall_mps = math.cos(about_z * dt_s), math.sin(about_z * dt_s), GRAVITY_MPS2 * dt_s
        next_ahead = c * ahead + s * left - dt_s * (about_y * up + bias_ahead)
        next_left = c * left - s * ahead + dt_s * (about_x * up - bias_left)
        self._x[SINES] = next_ahead, next_left
        bend_mps = dt_s * math.copysign(self._lateral_mps2(about_z) ** 2, speed)
        self._x[6] += dt_s * force_mps2[0] - fall_mps * (0.5 * (ahead + next_ahead) + zero_ahead) - bend_mps * slip
        self._x[7] += dt_s * force_mps2[1] - fall_mps * (0.5 * (left + next_left) + zero_left)
        F = np.eye(9)
        F[SINES, SINES] = (c, s), (-s, c)
        F[0, 2] = F[1, 3] = -dt_s
        F[6, 0] = F[6, 4] = F[7, 1] = F[7, 5] = -fall_mps
        F[6, SLIP] = -bend_mps
        P = F @ self._covariance @ F.T
        P.flat[::10] += dt_s * _WALKS**2
        self._covariance = 0.5 * (P + P.T)  # keeps rounding symmetric over hours

    def _correct(
        self, lateral_mps2: float, speed_mps: Sequence[float | None], noise: float, variance_ahead: float | None
    ) -> bool:
        P, jumped, (ahead, left) = self._covariance, False, speed_mps
        slips_mps = -lateral_mps2 * abs(ahead if ahead is not None else self._x[6])  # sideways, per unit of slip
        of_ahead = (noise, JUMP_SIGMA) if variance_ahead is None else (variance_ahead, OUTLIER_SIGMA)
        both = (6, ahead, 0.0, *of_ahead), (7, left, -slips_mps, noise, JUMP_SIGMA)
        for i, speed, shown, white, sigma in both:
            if speed is None:
                continue
            seen = P[:, i] + shown * P[:, SLIP]
            variance = float(seen[i] + shown * seen[SLIP])
            innovation = speed - float(self._x[i] + shown * self._x[SLIP])
            beyond = innovation**2 - sigma**2 * (variance + white)
            if beyond > 0:
                jumped = True
                P[i, i] += beyond
                seen[i] += beyond
                variance += beyond
            gain = seen / (variance + white)
            self._x += gain * innovation
            P -= np.outer(gain, seen)
        return jumped

    def _lateral_mps2(self, about_z_radps: float) -> float:
        return max(-MAX_LATERAL_MPS2, min(MAX_LATERAL_MPS2, about_z_radps * float(self._x[6])))


def _state(of_both: Sequence[float], of_slip: float) -> Floats:
    """A value per part of the state, equal ahead and left, (9,)."""
    return np.append(np.repeat(of_both, 2), of_slip)


_WALKS = _state([RATE_WALK, BIAS_WALK, ZERO_WALK, FORCE_WALK], SLIP_WALK)


def _bounded(sine: float) -> float:
    return max(-1.0, min(1.0, float(sine)))
