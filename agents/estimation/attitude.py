"""Slope along and across the machine: where the vertical points in the body's axes, by gyros and accelerometer.

With u the vertical in the body's axes (ahead, left, up), omega the rates of the gyros, f the specific force and a the
acceleration of the machine itself, along its track and towards the centre of a bend,

    du/dt = -omega x u          f = g u + a

The gyros predict u, the accelerometer corrects it. The parts of u ahead and to the left are the sines of the two
slopes, positive uphill.
"""

import math

from protocol.units import GRAVITY_MPS2

MAX_SINE = 0.7  # steeper than any machine stands
FIRST_STD = 0.05  # of the sine, after the first reading
# Noise of the specific force over NOISE_S, vibration included. It is taken as white: the variance of a reading grows as
# readings come faster.
FORCE_STD_MPS2 = 0.35
NOISE_S = 0.02
RATE_WALK = 1.5e-3  # random walk of the angle that the gyros do not see [rad/sqrt(s)]
BIAS_STD_RADPS = 2e-3  # of the gyro bias at start: 0.1 deg/s
BIAS_WALK = 3.5e-5  # random walk of the gyro bias [rad/s/sqrt(s)]: another 0.1 deg/s in an hour


class SlopeFilter:
    """Sines of the slopes ahead and to the left, each with a Kalman filter.

    A machine that turns on a slope exchanges the slope ahead for the one across: du/dt couples the two.
    """

    def __init__(self) -> None:
        self.ahead, self.left = _Sine(), _Sine()
        self._started = False

    def update(self, dt_s: float, rates_radps: tuple[float, float, float], force_mps2: tuple[float, float]) -> None:
        """Predict with the rates, correct with the specific force without the machine's own acceleration.

        rates_radps: about the axes ahead, left and up. force_mps2: ahead and to the left.
        """
        measured = [max(-MAX_SINE, min(MAX_SINE, force / GRAVITY_MPS2)) for force in force_mps2]
        if not self._started:
            self.ahead.sine, self.left.sine = measured
            self._started = True
            return
        x, y = self.ahead.sine, self.left.sine
        up = math.sqrt(max(1 - x * x - y * y, MAX_SINE**2))
        about_x, about_y, about_z = rates_radps
        self.ahead.update(dt_s, about_z * y - about_y * up, measured[0])
        self.left.update(dt_s, about_x * up - about_z * x, measured[1])


class _Sine:
    """Kalman filter over the sine of one slope and the bias of the rate that changes it [rad/s]."""

    def __init__(self) -> None:
        self.sine = 0.0
        self._bias = 0.0
        self._p00, self._p01, self._p11 = FIRST_STD**2, 0.0, BIAS_STD_RADPS**2

    @property
    def angle_rad(self) -> float:
        """The slope, positive uphill."""
        return math.asin(max(-1.0, min(1.0, self.sine)))

    @property
    def variance(self) -> float:
        """Variance of the sine."""
        return self._p00

    def update(self, dt_s: float, change_per_s: float, measured: float) -> None:
        self.sine += dt_s * (change_per_s - self._bias)
        p00, p01, p11 = self._p00, self._p01, self._p11
        p00 += dt_s * (dt_s * p11 - 2 * p01) + RATE_WALK**2 * dt_s
        p01 -= dt_s * p11
        p11 += BIAS_WALK**2 * dt_s
        noise = (FORCE_STD_MPS2 / GRAVITY_MPS2) ** 2 * NOISE_S / max(dt_s, 1e-3)
        innovation, total = measured - self.sine, p00 + noise
        gain, bias_gain = p00 / total, p01 / total
        self.sine += gain * innovation
        self._bias += bias_gain * innovation
        self._p00, self._p01, self._p11 = (1 - gain) * p00, (1 - gain) * p01, p11 - bias_gain * p01
